// Two pictures side by side. A press or drag in the left one asks; the answer is drawn over the right one.

const MARK = "#FFE100", TRUE = "#00FF6A", MODE = "#00E0FF";

function makePicture(box) {
  const canvas = document.createElement("canvas");
  canvas.style.cssText = "width: calc(50% - 4px); cursor: crosshair; touch-action: none";
  box.append(canvas);
  return canvas;
}

async function paint(canvas, bytes, overlay) {
  const image = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
  if (canvas.width !== image.width || canvas.height !== image.height) {
    canvas.width = image.width;
    canvas.height = image.height;
  }
  const context = canvas.getContext("2d");
  context.drawImage(image, 0, 0);
  overlay(context, image.width / 480); // lines as thick on every image
}

function drawPixel(context, unit, [x, y]) {
  context.beginPath();
  context.arc(x + 0.5, y + 0.5, 5 * unit, 0, 2 * Math.PI);
  Object.assign(context, { fillStyle: MARK, strokeStyle: "black", lineWidth: unit });
  context.fill();
  context.stroke();
}

function drawMode(context, unit, { x, y, weight, radii, angle }) {
  context.beginPath();
  context.ellipse(x + 0.5, y + 0.5, radii[0], radii[1], angle, 0, 2 * Math.PI);
  Object.assign(context, { strokeStyle: "white", lineWidth: unit });
  context.stroke();
  context.beginPath();
  context.arc(x + 0.5, y + 0.5, unit * (1.5 + 6 * Math.sqrt(weight)), 0, 2 * Math.PI);
  Object.assign(context, { strokeStyle: MODE, lineWidth: 1.4 * unit });
  context.stroke();
}

function drawCross(context, unit, [x, y]) {
  context.beginPath();
  for (const [dx, dy] of [[5, 0], [0, 5]]) {
    context.moveTo(x + 0.5 - dx * unit, y + 0.5 - dy * unit);
    context.lineTo(x + 0.5 + dx * unit, y + 0.5 + dy * unit);
  }
  Object.assign(context, { strokeStyle: TRUE, lineWidth: 2 * unit });
  context.stroke();
}

function render({ model, el }) {
  const box = document.createElement("div");
  box.className = "mmgsd-explorer";
  box.style.cssText = "display: flex; gap: 8px; align-items: flex-start; max-width: 1000px";
  el.append(box);
  const [left, right] = [makePicture(box), makePicture(box)];
  let waiting = false, next = null;

  const ask = (xy) => {
    if (waiting) { // a drag never lags: the latest place is asked about when the answer is here
      next = xy;
      return;
    }
    waiting = true;
    model.send({ xy });
  };
  model.on("msg:custom", () => { // answered
    waiting = false;
    const xy = next;
    next = null;
    if (xy) ask(xy);
  });
  const onPointer = (event) => {
    if (!(event.buttons & 1)) return;
    const { left: x0, top: y0, width, height } = left.getBoundingClientRect();
    const x = ((event.clientX - x0) / width) * left.width - 0.5;
    const y = ((event.clientY - y0) / height) * left.height - 0.5;
    if (x >= -0.5 && y >= -0.5 && x <= left.width - 0.5 && y <= left.height - 0.5) ask([x, y]);
  };
  left.addEventListener("pointerdown", onPointer);
  left.addEventListener("pointermove", onPointer);

  const show = () => {
    const { xy, modes, matches } = model.get("marks");
    paint(left, model.get("image0"), (context, unit) => xy && drawPixel(context, unit, xy));
    paint(right, model.get("image1"), (context, unit) => {
      modes.forEach((mode) => drawMode(context, unit, mode));
      matches.forEach((match) => drawCross(context, unit, match));
    });
  };
  model.on("change:marks", show);
  show();
}

export default { render };
