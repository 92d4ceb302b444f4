// From two images to an answer, as mmgsd/match/matcher.py: `model` is model.json, an image's `outputs` the network's.
// Planes are {data, shape: [channels, rows, columns]}; sizes are [width, height] px; places are [x, y] px.

import { fitModes } from "./mixture.js";

const sigmoid = (value) => 1 / (1 + Math.exp(-value));
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

// ---- images

export function fitInputSize([width, height], { size, input_size: trained, input_px: longer, least_px: least }) {
  if (width * size[1] === height * size[0]) return trained;
  const area = (longer ** 2 * Math.min(...size)) / Math.max(...size);
  const scale = Math.max(Math.sqrt(area / (width * height)), least / Math.min(width, height));
  return [width, height].map((side) => Math.round((side * scale) / 8) * 8);
}

// (3 * H * W) Float32Array in [0, 1], plane by plane, of RGBA `pixels`: OpenCV's INTER_AREA.
export function resize(pixels, [width, height], [toWidth, toHeight]) {
  const smaller = toWidth <= width && toHeight <= height;
  const [across, down] = [listTaps(width, toWidth, smaller), listTaps(height, toHeight, smaller)];
  const [narrow, out] = [new Float32Array(height * toWidth * 3), new Float32Array(3 * toWidth * toHeight)];
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < toWidth; x++) {
      for (const [from, share] of across[x]) {
        for (let c = 0; c < 3; c++) narrow[(y * toWidth + x) * 3 + c] += share * pixels[(y * width + from) * 4 + c];
      }
    }
  }
  for (let y = 0; y < toHeight; y++) {
    for (let x = 0; x < toWidth; x++) {
      for (let c = 0; c < 3; c++) {
        let value = 0;
        for (const [from, share] of down[y]) value += share * narrow[(from * toWidth + x) * 3 + c];
        out[(c * toHeight + y) * toWidth + x] = Math.round(clamp(value, 0, 255)) / 255;
      }
    }
  }
  return out;
}

function listTaps(count, wanted, smaller) {
  // [from, share] of each of the wanted columns, or rows
  const scale = count / wanted;
  return Array.from({ length: wanted }, (_, to) => {
    if (!smaller) {
      const from = Math.floor(to * scale);
      const beyond = to + 1 - (from + 1) / scale;
      const share = beyond <= 0 ? 0 : beyond - Math.floor(beyond);
      return [
        [Math.min(from, count - 1), 1 - share],
        [Math.min(from + 1, count - 1), share],
      ];
    }
    const [start, end, taps] = [to * scale, Math.min((to + 1) * scale, count), []];
    for (let from = Math.floor(start); from < end - 1e-6; from++) {
      taps.push([from, (Math.min(from + 1, end) - Math.max(from, start)) / (end - start)]);
    }
    return taps;
  });
}

// ---- planes

function sample({ data, shape: [channels, rows, columns] }, [x, y], size) {
  // bilinear
  const at = [((x + 0.5) * columns) / size[0] - 0.5, ((y + 0.5) * rows) / size[1] - 0.5];
  const [u, v] = [clamp(at[0], 0, columns - 1), clamp(at[1], 0, rows - 1)];
  const [left, top] = [Math.min(Math.floor(u), columns - 2), Math.min(Math.floor(v), rows - 2)];
  const [right, down] = [u - left, v - top];
  return Array.from({ length: channels }, (_, channel) => {
    const k = (channel * rows + top) * columns + left;
    const [above, below] = [k, k + columns].map((from) => data[from] * (1 - right) + data[from + 1] * right);
    return above * (1 - down) + below * down;
  });
}

function pool({ data, shape: [, rows, columns] }, [toRows, toColumns], bounds) {
  // the most of the cells within bounds
  const [down, across] = [
    [toRows, rows],
    [toColumns, columns],
  ].map(([to, from]) => Array.from({ length: to }, (_, k) => bounds(k, to, from)));
  const pooled = Float64Array.from({ length: toRows * toColumns }, (_, k) => {
    const [[top, bottom], [left, right]] = [down[Math.floor(k / toColumns)], across[k % toColumns]];
    let most = -Infinity;
    for (let row = top; row < bottom; row++)
      for (let column = left; column < right; column++) most = Math.max(most, data[row * columns + column]);
    return most;
  });
  return { data: pooled, shape: [1, toRows, toColumns] };
}

const shrink = (plane, shape) =>
  pool(plane, shape, (k, to, from) => [Math.floor((k * from) / to), Math.ceil(((k + 1) * from) / to)]);
const widen = (plane, reach) =>
  pool(plane, plane.shape.slice(1), (k, _, from) => [Math.max(k - reach, 0), Math.min(k + reach + 1, from)]);
const see = ({ data, shape }) => ({ data: Float64Array.from(data, sigmoid), shape });
const part = ({ data, shape: [, rows, columns] }, start, count) => ({
  data: data.subarray(start * rows * columns, (start + count) * rows * columns),
  shape: [count, rows, columns],
});

// ---- answers

export function computeHeatmap(source, outputs, model) {
  const target = part(outputs.descriptors, outputs.descriptors.shape[0] - model.dim, model.dim);
  const [, rows, columns] = target.shape;
  const squared = new Float64Array(rows * columns);
  source.forEach((value, channel) => {
    for (let k = 0; k < squared.length; k++) squared[k] += (value - target.data[channel * squared.length + k]) ** 2;
  });
  const least = squared.reduce((a, b) => Math.min(a, b));
  const scale = (model.bandwidth === null ? 1 : 1 / (2 * model.bandwidth ** 2)) / model.temperature;
  const heat = normalise(squared.map((value) => Math.exp(scale * (least - value))));
  if (!outputs.mask) return heat;
  const weights = widen(shrink(see(outputs.mask), [rows, columns]), 1).data;
  const weighted = heat.map((value, k) => value * Math.max(weights[k], model.elsewhere_weight));
  return weighted.reduce((a, b) => a + b) > 1e-12 ? normalise(weighted) : heat;
}

function normalise(values) {
  const total = values.reduce((a, b) => a + b);
  return values.map((value) => value / total);
}

// `mmgsd.match.places.shrink_sources`
function shrinkSource(source, { bandwidth, places }) {
  if (!places) return source;
  const { descriptors, temperature, shrinkage } = places;
  const measure = (place) => place.reduce((total, value, k) => total + (value - source[k]) ** 2, 0);
  const squared = descriptors.map(measure);
  const least = squared.reduce((a, b) => Math.min(a, b));
  const scale = temperature * (bandwidth === null ? 1 : 2 * bandwidth ** 2);
  const weights = normalise(squared.map((value) => Math.exp((least - value) / scale)));
  return source.map((value, k) => {
    const mean = weights.reduce((total, weight, place) => total + weight * descriptors[place][k], 0);
    return value + shrinkage * (mean - value);
  });
}

// The answer about one pixel `xy` of the first image, as `python -m mmgsd match --json` says it, with its heatmap and
// ellipses. Images are {size, outputs}.
export function match(image0, image1, xy, model) {
  const source = shrinkSource(sample(part(image0.outputs.descriptors, 0, model.dim), xy, image0.size), model);
  const [, rows, columns] = image1.outputs.descriptors.shape;
  const heat = computeHeatmap(source, image1.outputs, model);
  const { state, outside } = fitModes(heat, [rows, columns], model.modes, model.mixture);
  const cell = [image1.size[0] / columns, image1.size[1] / rows];
  const scale = Math.sqrt((image1.size[0] * image1.size[1]) / (model.size[0] * model.size[1]));
  const nats =
    heat.reduce((total, p) => total - (p > 0 ? p * Math.log(p) : 0), Math.log(cell[0] * cell[1])) - 2 * Math.log(scale);
  const known = lookUp(image0, image1, xy, model);
  const shown = (known.on_object ?? 1) * (1 - (known.absent ?? 0));
  const modes = state.map(([x, y, weight, a, b, c]) => {
    const place = [(x + columns / 2) * cell[0] - 0.5, (y + rows / 2) * cell[1] - 0.5];
    const covariance = [a * cell[0] ** 2, b * cell[0] * cell[1], c * cell[1] ** 2];
    const spread = Math.sqrt((covariance[0] + covariance[2]) / 2);
    const measured = [spread / scale, Math.min(1, state.length * weight), Math.exp(nats / 2)];
    const mode = { xy: place, weight, spread_px: spread, confidence: computeConfidence(measured, model) * shown };
    if (image1.outputs.surface) mode.visible = computeVisible(source, image1, place, model);
    return { ...mode, ellipse: computeEllipse(place, covariance) };
  });
  return { xy, modes, entropy: nats, outside, ...known, heat, shape: [rows, columns] };
}

function lookUp(image0, image1, xy, model) {
  const [{ mask }, { present }] = [image0.outputs, image1.outputs];
  if (!mask || !present) return {};
  const [, ...sides] = mask.shape;
  const coarse = sides.map((side) => Math.ceil(side * Math.min(1, model.looked_up / Math.max(...sides))));
  const reach = Math.max(1, Math.round(model.beside * Math.max(...coarse)));
  const [onObject] = sample(widen(shrink(see(mask), coarse), reach), xy, image0.size);
  const absent = 1 - sigmoid(present.data[0]);
  const share = (value) => `${Math.round(100 * value)} % sure`;
  const said =
    absent > model.likely
      ? `The right image does not show the object (${share(absent)}).`
      : onObject < model.likely
        ? `The pixel is not on the object (${share(1 - onObject)}).`
        : "";
  return { on_object: onObject, absent, said };
}

function computeVisible(source, { outputs, size }, place, model) {
  const there = sample(outputs.descriptors, place, size);
  const roles = Array.from({ length: there.length / model.dim }, (_, role) =>
    source.map((value, k) => value - there[role * model.dim + k]),
  );
  const near = roles.map(
    (apart) =>
      Math.min(
        apart.reduce((total, value) => total + value ** 2, 0),
        50,
      ) / 10,
  );
  const layer = ([weights, biases], x) =>
    weights.map((row, k) => row.reduce((total, w, i) => total + w * x[i], biases[k]));
  const hidden = layer(model.judge[0], [...roles.flat(), ...near, ...sample(outputs.surface, place, size)]);
  return sigmoid(
    layer(
      model.judge[1],
      hidden.map((value) => Math.max(value, 0)),
    )[0],
  );
}

function computeConfidence([spread, share, extent], { calibration, radius_px: radius }) {
  if (!calibration) return share * -Math.expm1(-0.5 * (radius / spread) ** 2);
  const { levels, table, powers } = calibration;
  const at = radius / (spread ** powers[0] * Math.max(share, 1e-6) ** powers[1] * extent ** powers[2]);
  const next = table.findIndex((distance) => distance > at);
  if (next < 0) return levels.at(-1);
  const [from, low] = next ? [table[next - 1], levels[next - 1]] : [0, 0];
  return low + ((levels[next] - low) * (at - from)) / (table[next] - from);
}

function computeEllipse([x, y], [a, b, c]) {
  // of 1 std, its angle that of the longer axis
  const [middle, reach] = [(a + c) / 2, Math.hypot((a - c) / 2, b)];
  return {
    x,
    y,
    major: Math.sqrt(middle + reach),
    minor: Math.sqrt(Math.max(middle - reach, 0)),
    angle: Math.atan2(2 * b, a - c) / 2,
  };
}
