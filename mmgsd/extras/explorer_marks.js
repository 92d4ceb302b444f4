// Nodes and marks of the explorer: the first of its three scripts, which explorer.py puts together as one module.

// of points, as many as explorer.py lets one pin
const COLOURS = ["#00E0FF", "#FF5CC8", "#8CFF4A", "#B79BFF", "#FFFFFF", "#FF9A3D", "#FFE100", "#FF6B6B"];

function make(tag, properties = {}, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children); // strings become text, whatever they hold
  return node;
}

function download(blob, name) {
  const link = make("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

const decode = (bytes) => createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
const toBytes = (view) => new Uint8Array(view.buffer, view.byteOffset, view.byteLength);

// ---- tables of modes

const percent = (value) => `${(100 * value).toFixed(0)} %`;
const isHidden = ({ visible }) => visible < 0.5; // where it is known

// A row a mode, the first column headed by `word`; `share` makes the content of a cell from a share.
function makeModes(word, modes, caption, share = percent) {
  const row = (kind, cells) => make("tr", {}, ...cells.map((cell) => make(kind, {}, ...[cell].flat())));
  const tell = (mode, m) => [mode.answer ?? m + 1, ...mode.xy.map((value) => value.toFixed(1)), share(mode.weight),
    `± ${mode.spread_px.toFixed(0)} px`, share(mode.confidence),
    ...(mode.visible === undefined ? [] : [`${isHidden(mode) ? "hidden" : "seen"}, ${percent(mode.visible)}`])];
  const known = modes[0]?.visible === undefined ? [] : ["seen there"];
  const head = row("th", [word, "x px", "y px", "weight", "spread", "confidence", ...known]);
  return make("table", {}, make("caption", {}, ...caption), make("thead", {}, head),
    make("tbody", {}, ...modes.map((mode, m) => row("td", tell(mode, m)))));
}

// ---- drawing: `place` says where image pixels go, {scale, x, y}; `unit` is the thickness of a line

function drawImage(context, place, bitmap, [width, height], smooth = false) {
  const box = [place.x, place.y, place.scale * width, place.scale * height];
  context.imageSmoothingEnabled = smooth || place.scale * width < 6 * bitmap.width; // closer, pixels are looked for
  context.imageSmoothingQuality = "high";
  context.drawImage(bitmap, ...box);
}

const locate = (place, x, y) => [place.x + place.scale * (x + 0.5), place.y + place.scale * (y + 0.5)];

function stroke(context, colour, width) { // with a dark edge, to be seen on everything
  Object.assign(context, { strokeStyle: "rgba(0, 0, 0, 0.65)", lineWidth: 2.2 * width });
  context.stroke();
  Object.assign(context, { strokeStyle: colour, lineWidth: width });
  context.stroke();
}

function drawPixel(context, place, unit, colour, [x, y]) {
  context.beginPath();
  context.arc(...locate(place, x, y), 5.5 * unit, 0, 2 * Math.PI);
  Object.assign(context, { fillStyle: colour, strokeStyle: "black", lineWidth: 1.5 * unit });
  context.fill();
  context.stroke();
}

function drawMode(context, place, unit, colour, { x, y, major, minor, angle }, weight, { hidden, faint } = {}) {
  context.save();
  context.setLineDash(hidden ? [4 * unit, 3 * unit] : []);
  context.globalAlpha = faint ? 0.35 : 1;
  context.beginPath();
  context.ellipse(...locate(place, x, y), place.scale * major, place.scale * minor, angle, 0, 2 * Math.PI);
  stroke(context, colour, unit);
  context.beginPath();
  context.arc(...locate(place, x, y), unit * (2 + 8 * Math.sqrt(weight)), 0, 2 * Math.PI);
  stroke(context, colour, 2 * unit);
  context.restore();
}

function drawCross(context, place, unit, colour, [x, y]) {
  const [u, v] = locate(place, x, y);
  context.beginPath();
  for (const [dx, dy] of [[6 * unit, 0], [0, 6 * unit]]) {
    context.moveTo(u - dx, v - dy);
    context.lineTo(u + dx, v + dy);
  }
  Object.assign(context, { strokeStyle: "black", lineWidth: 5.5 * unit });
  context.stroke();
  Object.assign(context, { strokeStyle: colour, lineWidth: 3.8 * unit });
  context.stroke();
  Object.assign(context, { strokeStyle: "white", lineWidth: 1.5 * unit });
  context.stroke();
}

function makeHeat(answer, colours) { // the small heatmap as a picture, opaque where it is hot
  const [width, height] = answer.heat_size;
  const [strength, table, pixels] = [toBytes(answer.heat), toBytes(colours), new ImageData(width, height)];
  strength.forEach((value, k) => pixels.data.set([...table.subarray(3 * value, 3 * value + 3), value], 4 * k));
  const canvas = make("canvas", { width, height });
  canvas.getContext("2d").putImageData(pixels, 0, 0);
  return canvas;
}

function sign(draw) { // of the legend, as marks are drawn on the pictures
  const canvas = make("canvas", { width: 36, height: 36, style: "width: 18px; height: 18px" });
  draw(canvas.getContext("2d"), { scale: 1, x: 17.5, y: 17.5 }, 2, COLOURS[0]);
  return canvas;
}
