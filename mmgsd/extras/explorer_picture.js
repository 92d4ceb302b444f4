// One of the explorer's two pictures: its caption, its canvas, and what part of it is seen.

const MOST_ZOOM = 40;

class Picture {
  constructor(word, onFiles) {
    this.name = make("span");
    this.input = make("input", { type: "file", accept: "image/*,.heic,.heif", multiple: true, hidden: true });
    const title = `Another ${word} image, or two files at once for both; files can be dropped on the pictures as well`;
    const choose = make("button", { type: "button", textContent: "choose file…", title });
    choose.onclick = () => this.input.click();
    this.input.onchange = () => {
      onFiles([...this.input.files]);
      this.input.value = ""; // the same file may be chosen again
    };
    this.canvas = make("canvas", { ariaLabel: `${word} image` });
    this.canvas.setAttribute("role", "img");
    this.box = make("div", { className: "mmgsd-picture" },
      make("div", { className: "mmgsd-caption" }, this.name, choose, this.input), this.canvas);
    this.size = [1, 1];
    this.fit();
    this.takeDrops(onFiles);
  }

  takeDrops(onFiles) {
    for (const kind of ["dragover", "dragleave", "drop"]) {
      this.canvas.addEventListener(kind, (event) => {
        event.preventDefault();
        event.stopPropagation();
        this.canvas.classList.toggle("mmgsd-drop", kind === "dragover");
        if (kind === "drop") onFiles([...event.dataTransfer.files]);
      });
    }
  }

  fit() {
    [this.zoom, this.centre] = [1, null];
  }

  get place() { // in the canvas's own pixels on the screen
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight];
    const scale = this.zoom * Math.min(width / this.size[0], height / this.size[1]);
    const [u, v] = this.centre ?? [this.size[0] / 2, this.size[1] / 2];
    return { scale, x: width / 2 - scale * u, y: height / 2 - scale * v };
  }

  toPixel(event) { // null outside the image
    const [box, place] = [this.canvas.getBoundingClientRect(), this.place];
    const x = (event.clientX - box.left - place.x) / place.scale;
    const y = (event.clientY - box.top - place.y) / place.scale;
    return x >= 0 && y >= 0 && x <= this.size[0] && y <= this.size[1] ? [x - 0.5, y - 0.5] : null;
  }

  move(dx, dy) {
    const { scale, x, y } = this.place;
    this.look((this.canvas.clientWidth / 2 - x - dx) / scale, (this.canvas.clientHeight / 2 - y - dy) / scale);
  }

  look(u, v) {
    const within = (value, size) => Math.min(Math.max(value, 0), size);
    this.centre = this.zoom > 1 ? [within(u, this.size[0]), within(v, this.size[1])] : null;
  }

  zoomBy(factor, event = null) { // what is under the pointer stays there
    const [box, before, zoom] = [this.canvas.getBoundingClientRect(), this.place, this.zoom];
    const [u, v] = event ? [event.clientX - box.left, event.clientY - box.top] : [box.width / 2, box.height / 2];
    this.zoom = Math.min(Math.max(zoom * factor, 1), MOST_ZOOM);
    const scale = (before.scale * this.zoom) / zoom;
    this.look((u - before.x) / before.scale + (box.width / 2 - u) / scale,
      (v - before.y) / before.scale + (box.height / 2 - v) / scale);
  }

  draw(paint) {
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(this.canvas.clientWidth * ratio);
    this.canvas.height = Math.round(this.canvas.clientHeight * ratio);
    const context = this.canvas.getContext("2d");
    const { scale, x, y } = this.place;
    paint(context, { scale: scale * ratio, x: x * ratio, y: y * ratio }, ratio);
  }
}
