// The mixture that mmgsd/match/mixture.py fits, for one heatmap; its constants come with the model (`how`).
// A component is [x, y, weight, a, b, c]: mean and covariance [[a, b], [b, c]] in cells, from the grid's centre.

const sum = (values) => values.reduce((total, value) => total + value, 0);

// Components of `n` modes fitted to `heat` (rows * columns, row by row), most probable first; absent ones are left out.
export function fitModes(heat, [rows, columns], n, how) {
  const total = sum(heat);
  const even = 1 / (rows * columns);
  const mass = interpolate(
    Float64Array.from(heat, (value) => (total > 0 ? value / total : even)),
    rows,
    columns,
    how,
  );
  const cells = describeCells(rows, columns);
  let state = fit(raise(mass, how.power), cells, n, how);
  if (how.power !== 1 || how.sharpness !== 1) state = measureShares(mass, state, cells, how);
  state = merge(state);
  return {
    state: state.filter(([, , weight]) => weight > 0).sort((p, q) => q[2] - p[2]),
    outside: measureOutside(mass, state, cells, how),
  };
}

function describeCells(rows, columns) {
  const [x, y] = [new Float64Array(rows * columns), new Float64Array(rows * columns)];
  for (let k = 0; k < x.length; k++) {
    x[k] = (k % columns) - (columns - 1) / 2;
    y[k] = Math.floor(k / columns) - (rows - 1) / 2;
  }
  return { x, y, rows, columns };
}

function interpolate(mass, rows, columns, { spread }) {
  // what a bilinear resize to pixels does to the moments
  const along = (values, count, step, start) => {
    const line = Array.from({ length: count }, (_, k) => values[start + k * step]);
    line.forEach((value, k) => {
      values[start + k * step] =
        spread[0] * line[Math.max(k - 1, 0)] + spread[1] * value + spread[2] * line[Math.min(k + 1, count - 1)];
    });
  };
  for (let row = 0; row < rows; row++) along(mass, columns, 1, row * columns);
  for (let column = 0; column < columns; column++) along(mass, rows, columns, column);
  return mass;
}

function raise(mass, power) {
  if (power === 1) return mass;
  const most = mass.reduce((a, b) => Math.max(a, b), 1e-30);
  const raised = mass.map((value) => (value / most) ** power);
  const total = sum(raised);
  return raised.map((value) => value / total);
}

function fit(mass, cells, n, how) {
  // where a component collapsed, the likelier of that and one from the peaks
  const state = fitFrom(how.annealing, mass, cells, n, how);
  if (!state.some(([, , weight]) => weight > 0 && weight * n < how.collapsed)) return state;
  const again = fitFrom([], mass, cells, n, how);
  const [before, after] = [state, again].map((one) => computeLogLikelihood(mass, one, cells, how));
  return after > before ? again : state;
}

function fitFrom(temperatures, mass, cells, n, how) {
  const { rows, columns } = cells;
  const [h, w] = [Math.ceil(rows / 2), Math.ceil(columns / 2)];
  const coarse = new Float64Array(h * w);
  mass.forEach((value, k) => {
    coarse[(Math.floor(k / columns) >> 1) * w + ((k % columns) >> 1)] += value;
  });
  const halved = describeCells(h, w);
  let state = findPeaks(coarse, h, w, n, how);
  for (const temperature of temperatures) {
    const flat = coarse.map((value) => value ** (1 / temperature));
    const total = sum(flat);
    flat.forEach((value, k) => {
      flat[k] = value / total;
    });
    for (let k = 0; k < how.annealing_cycles; k++) state = runCycle(flat, state, halved, how);
  }
  state = state.map(([x, y, weight, a, b, c]) => [
    2 * x + 0.5 * (columns % 2),
    2 * y + 0.5 * (rows % 2),
    weight,
    4 * a,
    4 * b,
    4 * c,
  ]);
  for (let k = 0; k < how.cycles; k++) {
    const after = runCycle(mass, state, cells, how);
    const moved = Math.max(
      ...after.map((one, i) => Math.max(Math.abs(one[0] - state[i][0]), Math.abs(one[1] - state[i][1]))),
    );
    state = after;
    if (moved <= how.tolerance) break;
  }
  return computeMoments(mass, state, cells, how).map((one) => one.with(2, Math.max(one[2], 1e-9)));
}

function findPeaks(mass, rows, columns, n, { kernel }) {
  // one after another, each taking the mass around it away
  const bell = (distance) => Math.exp(-0.5 * (distance / kernel) ** 2);
  const rest = mass.slice();
  return Array.from({ length: n }, () => {
    const wide = new Float64Array(rest.length);
    const local = new Float64Array(rest.length);
    for (let row = 0; row < rows; row++)
      for (let to = 0; to < columns; to++)
        for (let from = 0; from < columns; from++) {
          wide[row * columns + to] += rest[row * columns + from] * bell(to - from);
        }
    for (let to = 0; to < rows; to++)
      for (let from = 0; from < rows; from++)
        for (let column = 0; column < columns; column++) {
          local[to * columns + column] += wide[from * columns + column] * bell(to - from);
        }
    const score = local.map((value, k) => value * (rest[k] + 1e-3 * value));
    const peak = score.indexOf(score.reduce((a, b) => Math.max(a, b)));
    const [row, column] = [Math.floor(peak / columns), peak % columns];
    rest.forEach((value, k) => {
      rest[k] = value * (1 - bell(Math.floor(k / columns) - row) * bell((k % columns) - column));
    });
    return [column - (columns - 1) / 2, row - (rows - 1) / 2, 1 / n, kernel ** 2, 0, kernel ** 2];
  });
}

function runCycle(mass, state, cells, how) {
  // two steps of expectation-maximisation, a leap, a step (SQUAREM)
  const first = step(mass, state, cells, how);
  const second = step(mass, first, cells, how);
  const [pace, change] = [[], []];
  state.forEach((one, i) =>
    one.forEach((value, k) => {
      pace.push(first[i][k] - value);
      change.push(second[i][k] - 2 * first[i][k] + value);
    }),
  );
  const length = Math.min(Math.max(Math.hypot(...pace) / Math.max(Math.hypot(...change), 1e-12), 1), how.leap);
  const leapt = state.map((one, i) =>
    one.map((value, k) => value + 2 * length * pace[6 * i + k] + length ** 2 * change[6 * i + k]),
  );
  const least = how.min_variance;
  const lawful = leapt.every(
    ([, , weight, a, b, c]) => a > least && c > least && a * c - b * b > least ** 2 && weight >= 0,
  );
  return step(mass, lawful ? leapt : second, cells, how);
}

function step(mass, state, cells, how) {
  // with the priors
  const found = computeMoments(mass, state, cells, how);
  const width =
    sum(found.map(([, , weight, a, , c]) => 0.5 * weight * (a + c))) / sum(found.map(([, , weight]) => weight));
  const present = found.map(([, , weight], k) => (state[k][2] > 0 ? weight + how.prior_weight : 0));
  const total = sum(present);
  const blend = (weight, value, prior) => (weight * value + how.roundness * prior) / (weight + how.roundness);
  return found.map(([x, y, weight, a, b, c], k) => [
    x,
    y,
    present[k] / total,
    blend(weight, a, width),
    blend(weight, b, 0),
    blend(weight, c, width),
  ]);
}

// Calls `take(cell, shares)` with each component's share of each cell's mass.
function share(mass, state, { x, y }, take) {
  const lines = state.map(describeLogDensity);
  const shares = new Float64Array(state.length);
  for (let k = 0; k < mass.length; k++) {
    let [most, total] = [-Infinity, 0];
    lines.forEach((line, i) => {
      most = Math.max(most, (shares[i] = computeLogDensity(line, x[k], y[k])));
    });
    for (let i = 0; i < shares.length; i++) total += shares[i] = Math.exp(shares[i] - most);
    for (let i = 0; i < shares.length; i++) shares[i] *= mass[k] / total;
    take(k, shares);
  }
}

function describeLogDensity([x, y, weight, a, b, c]) {
  // coefficients of 1, x, y, x², xy, y², less the constant ln 2π
  const determinant = a * c - b * b;
  const [p, q, r] = [c / determinant, -b / determinant, a / determinant];
  const origin = Math.log(weight) - 0.5 * Math.log(determinant) - 0.5 * (p * x * x + 2 * q * x * y + r * y * y);
  return [Math.max(origin, -1e30), p * x + q * y, q * x + r * y, -0.5 * p, -q, -0.5 * r];
}

const computeLogDensity = ([one, u, v, uu, uv, vv], x, y) => one + u * x + v * y + uu * x * x + uv * x * y + vv * y * y;

function computeMoments(mass, state, cells, { min_variance: least }) {
  const moments = state.map(() => new Float64Array(6));
  share(mass, state, cells, (k, shares) => {
    const [x, y] = [cells.x[k], cells.y[k]];
    for (let i = 0; i < shares.length; i++) {
      const [moment, part] = [moments[i], shares[i]];
      moment[0] += part;
      moment[1] += part * x;
      moment[2] += part * y;
      moment[3] += part * x * x;
      moment[4] += part * x * y;
      moment[5] += part * y * y;
    }
  });
  return moments.map(([weight, ...sums], i) => {
    if (weight <= 1e-9) return state[i].with(2, weight);
    const [x, y, xx, xy, yy] = sums.map((value) => value / weight);
    return [x, y, weight, Math.max(xx - x * x, least) + 1e-3, xy - x * y, Math.max(yy - y * y, least) + 1e-3];
  });
}

function computeLogLikelihood(mass, state, { x, y }, { even, spread }) {
  const lines = state.map(([u, v, weight, a, b, c]) =>
    describeLogDensity([u, v, weight, a + 2 * spread[0], b, c + 2 * spread[0]]),
  );
  const floor = (2 * Math.PI * even) / mass.length;
  return sum(
    mass.map(
      (part, k) => part * Math.log(floor + sum(lines.map((line) => Math.exp(computeLogDensity(line, x[k], y[k]))))),
    ),
  );
}

function measureShares(mass, state, cells, how) {
  // means of sharper shares of the mass, covariances of the shares
  const found = computeMoments(mass, state, cells, how);
  const parts = state.map(() => new Float64Array(mass.length));
  share(mass, state, cells, (k, shares) =>
    parts.forEach((part, i) => {
      part[k] = shares[i];
    }),
  );
  return state.map((one, i) => {
    const most = parts[i].reduce((a, b) => Math.max(a, b), 1e-30);
    let [total, x, y] = [0, 0, 0];
    parts[i].forEach((value, k) => {
      const sharp = (value / most) ** how.sharpness;
      total += sharp;
      x += sharp * cells.x[k];
      y += sharp * cells.y[k];
    });
    const mean = found[i][2] > 1e-9 ? [x / Math.max(total, 1e-9), y / Math.max(total, 1e-9)] : one.slice(0, 2);
    return [...mean, one[2], ...found[i].slice(3)];
  });
}

function merge(state) {
  // components less than a cell apart are one, with their moments together
  const weights = state.map(([, , weight]) => weight);
  let into = state.map(([x, y]) => {
    const near = state.map(([u, v], k) => (Math.hypot(u - x, v - y) < 1 ? weights[k] : -1));
    return near.indexOf(Math.max(...near));
  });
  for (let k = 0; k < 2; k++) into = into.map((target) => into[target]); // of a chain
  return state.map((_, target) => {
    const parts = state.filter((_, k) => into[k] === target);
    const total = sum(parts.map(([, , weight]) => weight));
    if (!total) return [0, 0, 0, 1, 0, 1];
    const average = (of) => sum(parts.map((part) => part[2] * of(part))) / total;
    const [x, y] = [average(([u]) => u), average(([, v]) => v)];
    const spread = [
      (u, v, a) => a + (u - x) ** 2,
      (u, v, a, b) => b + (u - x) * (v - y),
      (u, v, a, b, c) => c + (v - y) ** 2,
    ];
    return [x, y, total, ...spread.map((of) => average(([u, v, , a, b, c]) => of(u, v, a, b, c)))];
  });
}

function measureOutside(mass, state, { x, y }, { ellipse }) {
  const present = state.filter(([, , weight]) => weight > 0);
  const holds = ([u, v, , a, b, c], k) => {
    const [dx, dy] = [x[k] - u, y[k] - v];
    return c * dx * dx - 2 * b * dx * dy + a * dy * dy <= ellipse * (a * c - b * b);
  };
  return sum(mass.map((part, k) => (present.some((one) => holds(one, k)) ? 0 : part)));
}
