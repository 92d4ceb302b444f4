// The explorer in the browser. The left picture asks, the right one answers; what both show is the kernel's to say (see
// explorer.py). Text from files only ever becomes text nodes, never markup.

const PATIENCE_MS = 60000; // then the kernel is taken for gone, and the next click asks again
const PART_BYTES = 4 << 20; // of a file a message: Jupyter's servers close the connection at 10 MiB
const MOST_BYTES = 100 << 20;
const RESTING_SHARE = 0.68; // of the window's height, for the pictures
const TOGETHER = "One turn or flip of the object for all points, of the answers beside (a; b for the next)";
const FLAT = "Ask for places of the object, laid flat on the left, instead of an image's pixels (l)";
const PARTS = { heatmap: "h", modes: "m", "true matches": "t" };
const HELP = [["click, drag", "ask"], ["shift + click", "pin"], ["ctrl + wheel", "zoom"], ["alt + drag", "move"],
  ["p", "previous"], ["r", "random"], ["n", "next"], ["h", "heatmap"], ["m", "modes"], ["t", "true matches"],
  ["v", "move or ask"], ["+", "closer"], ["-", "farther"], ["0", "fit"], ["c", "clear"], ["f", "full screen"],
  ["a", "points together"], ["b", "next answer"], ["l", "laid flat"],
  ["s", "save picture"], ["j", "save JSON"],
  ["k", "save marks"]];

class Explorer {
  constructor(model) {
    this.model = model;
    this.me = Math.random().toString(36).slice(2);
    this.asked = 0;
    this.waiting = null; // token of the question that the kernel has not answered
    this.queue = [];
    this.seen = null; // the pair whose pictures are on the screen
    this.shown = new Set(Object.keys(PARTS));
    this.moving = false;
    this.chosen = 0; // which of the answers that belong together is drawn in full
    this.build();
    this.connect();
    this.open();
  }

  build() {
    const button = (textContent, title, onclick) => make("button", { type: "button", textContent, title, onclick });
    const group = (...nodes) => make("div", { className: "mmgsd-group" }, ...nodes);
    this.method = make("select", { ariaLabel: "method", title: "Which model or descriptor answers" });
    this.toggles = {};
    for (const [part, key] of Object.entries(PARTS)) {
      this.toggles[part] = button(part, `Show or hide (${key})`, () => this.toggle(part));
    }
    this.count = make("span", { className: "mmgsd-count" });
    this.joiner = button("together", TOGETHER, () => this.join());
    this.answers = make("select", { ariaLabel: "answer", title: "Which answer is drawn in full, the others faint" });
    const step = (to, key) => button(to, `Another pair (${key})`, () => this.send({ do: "step", to }));
    this.mover = button("move", "Drag moves the picture and the wheel zooms (v)", () => this.setMoving(!this.moving));
    this.pictures = ["left", "right"].map((word, side) => new Picture(word, (files) => this.upload(files, side)));
    this.line = make("div", { className: "mmgsd-line", ariaLive: "polite" });
    this.tables = make("div", { className: "mmgsd-tables" });
    this.savers = [button("save picture", "Both pictures with their marks, as PNG (s)", () => this.savePicture()),
      button("save JSON", "The answer, as of python -m mmgsd match --json (j)", () => this.saveJson()),
      button("save marks", "Points pinned on left images, for python -m mmgsd measure (k)", () => this.saveMarks())];
    this.clearer = button("clear points", "Forget all points (c)", () => this.send({ do: "clear" }));
    this.box = make("div", { className: "mmgsd-explorer", tabIndex: 0 },
      make("div", { className: "mmgsd-bar" },
        group(make("span", { className: "mmgsd-word", textContent: "method" }), this.method),
        group(...Object.values(this.toggles)),
        group(this.joiner, this.answers),
        group(step("previous", "p"), step("random", "r"), step("next", "n"),
          button("laid flat", FLAT, () => this.send({ do: "flat" })), this.count)),
      make("div", { className: "mmgsd-bar" },
        group(this.mover,
          button("−", "Farther (-)", () => this.zoom(1 / 1.5)),
          button("+", "Closer (+)", () => this.zoom(1.5)),
          button("fit", "The whole of both pictures (0)", () => this.fit())),
        group(button("full screen", "The whole screen, and back (f)", () => this.toggleScreen())),
        group(this.clearer),
        group(...this.savers)),
      make("div", { className: "mmgsd-pictures" }, ...this.pictures.map((picture) => picture.box)),
      makeLegend(toBytes(this.model.get("heat_colours"))), this.line, this.tables, makeHelp());
    this.box.setAttribute("data-lm-suppress-shortcuts", "true"); // JupyterLab's, of which one cuts the cell
  }

  connect() {
    this.listening = [["change:pair", () => this.open()], ["change:answer", () => this.update()],
      ["change:method", () => this.update()], ["change:together", () => this.update()], ["change:methods", () => this.update()],
      ["msg:custom", (told) => this.hear(told)]];
    this.listening.forEach(([name, act]) => this.model.on(name, act));
    this.method.onchange = () => this.send({ do: "method", name: this.method.value });
    this.answers.onchange = () => this.choose(this.answers.selectedIndex);
    this.box.addEventListener("keydown", (event) => this.onKey(event));
    this.pictures.forEach((picture, side) => {
      picture.canvas.addEventListener("pointerdown", (event) => this.onPointer(picture, side, event));
      picture.canvas.addEventListener("pointermove", (event) => this.onPointer(picture, side, event));
      picture.canvas.addEventListener("wheel", (event) => this.onWheel(picture, event), { passive: false });
    });
    this.watcher = new ResizeObserver(() => this.draw());
    this.watcher.observe(this.box);
  }

  remove() {
    this.listening.forEach(([name, act]) => this.model.off(name, act));
    this.watcher.disconnect();
    clearTimeout(this.timer);
  }

  // ---- what the kernel says

  async open() { // names, pictures and number of a pair change together
    const pair = this.model.get("pair");
    let bitmaps;
    try {
      bitmaps = await Promise.all([pair.image0, pair.image1, pair.faded1].map(decode));
    } catch (error) {
      return this.say(`The pair's pictures cannot be shown: ${error.message}`, true);
    }
    if (pair.id !== this.model.get("pair").id) return; // overtaken by another
    const again = pair.id === this.seen?.id;
    this.seen = { ...pair, bitmaps };
    if (again) return;
    this.queue = []; // of another pair
    this.pictures.forEach((picture, side) => {
      picture.size = pair.sizes[side];
      picture.name.textContent = picture.name.title = pair.names[side];
      picture.fit();
    });
    this.count.textContent = `pair ${pair.number} of ${pair.count}`;
    this.say("Click or drag in the left image.");
    this.update();
  }

  get answer() { // that of the pair which is seen, or none
    const answer = this.model.get("answer");
    return this.seen && answer.pair === this.seen.id ? answer : { json: "[]", points: [] };
  }

  update() { // what hangs on the answer and on the method
    const { json, milliseconds, heat } = this.answer;
    this.queries = JSON.parse(json);
    this.heat = heat && this.queries.length ? makeHeat(this.answer, this.model.get("heat_colours")) : null;
    const options = this.model.get("methods").map(([value, textContent]) => make("option", { value, textContent }));
    this.method.replaceChildren(...options);
    this.method.value = this.model.get("method");
    if (this.queries.length) this.say(`${this.method.selectedOptions[0]?.textContent} answered in ${milliseconds} ms`);
    for (const node of [this.clearer, this.savers[1]]) node.disabled = !this.queries.length;
    this.toggles["true matches"].disabled = !this.seen?.truth;
    const joint = this.answer.joint ?? [];
    this.chosen = joint.length ? this.chosen % joint.length : 0;
    const name = (weight, k) => make("option", { textContent: `answer ${k + 1}, ${(100 * weight).toFixed(0)} %` });
    this.answers.replaceChildren(...joint.map(name));
    this.answers.hidden = !joint.length;
    this.answers.selectedIndex = joint.length ? this.chosen : -1;
    this.tables.replaceChildren(...this.queries.map((query, k) => this.makeTable(query, k)));
    this.draw();
  }

  hear({ token, error }) {
    if (error) this.say(error, true);
    if (token === this.waiting) this.release();
  }

  say(text, wrong = false) {
    this.line.textContent = text;
    this.line.classList.toggle("mmgsd-error", wrong);
  }

  // ---- what the kernel is asked

  ask(xy, pin) {
    const question = { do: "ask", pair: this.seen.id, xy, pin };
    this.queue = [...this.queue.filter((other) => other.pin), question]; // only a drag's latest place: it never lags
    if (!this.waiting) this.release();
  }

  release() {
    clearTimeout(this.timer);
    this.waiting = null;
    const question = this.queue.shift();
    if (!question) return;
    this.waiting = this.send(question);
    this.timer = setTimeout(() => {
      this.say(`The kernel has not answered for ${PATIENCE_MS / 1000} s: is it running?`, true);
      this.release();
    }, PATIENCE_MS);
  }

  send(message, buffers) {
    const token = `${this.me}-${++this.asked}`;
    this.model.send({ ...message, token }, undefined, buffers);
    return token;
  }

  async upload(files, side) {
    if (files.length > 2) return this.say("Choose one image, or two for both sides.", true);
    for (const [k, file] of files.entries()) {
      if (file.size > MOST_BYTES) {
        return this.say(`${file.name} is larger than ${MOST_BYTES >> 20} MiB: make it smaller.`, true);
      }
      const parts = Math.max(1, Math.ceil(file.size / PART_BYTES));
      this.say(`Reading ${file.name} …`);
      for (let part = 0; part < parts; part++) {
        const buffer = await file.slice(part * PART_BYTES, (part + 1) * PART_BYTES).arrayBuffer();
        this.send({ do: "file", side: files.length === 2 ? k : side, name: file.name, part, parts }, [buffer]);
      }
    }
  }

  // ---- mouse and keys

  onPointer(picture, side, event) {
    if (event.type === "pointerdown") {
      this.box.focus({ preventScroll: true });
      picture.canvas.setPointerCapture(event.pointerId);
      event.preventDefault();
    }
    if (!event.buttons || !this.seen) return;
    const asks = side === 0 && event.buttons === 1 && !event.altKey && !this.moving;
    if (!asks) {
      if (event.type === "pointermove") picture.move(event.movementX, event.movementY);
      return this.draw();
    }
    const xy = picture.toPixel(event);
    if (xy && (event.type === "pointerdown" || !event.shiftKey)) this.ask(xy, event.shiftKey);
  }

  onWheel(picture, event) {
    if (!(event.ctrlKey || event.metaKey || this.moving)) return; // the page scrolls
    event.preventDefault();
    event.stopPropagation();
    picture.zoomBy(Math.exp(-0.002 * event.deltaY), event);
    this.draw();
  }

  onKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    const step = (to) => () => this.send({ do: "step", to });
    const act = {
      p: step("previous"), r: step("random"), n: step("next"), v: () => this.setMoving(!this.moving),
      "+": () => this.zoom(1.5), "=": () => this.zoom(1.5), "-": () => this.zoom(1 / 1.5), 0: () => this.fit(),
      c: () => this.send({ do: "clear" }), f: () => this.toggleScreen(),
      a: () => this.join(), l: () => this.send({ do: "flat" }), b: () => this.choose(this.chosen + 1),
      s: () => this.savePicture(), j: () => this.saveJson(), k: () => this.saveMarks(),
      ...Object.fromEntries(Object.entries(PARTS).map(([part, key]) => [key, () => this.toggle(part)])),
    }[event.key.toLowerCase()];
    if (!act) return;
    event.preventDefault();
    event.stopPropagation();
    act();
  }

  toggle(part) {
    if (!this.shown.delete(part)) this.shown.add(part);
    this.draw();
  }

  join() { // all points under one member of the symmetry, or each by itself
    this.send({ do: "together", on: !this.model.get("together") });
  }

  choose(answer) {
    this.chosen = answer;
    this.update();
  }

  setMoving(moving) {
    this.moving = moving;
    this.draw();
  }

  zoom(factor) {
    this.pictures.forEach((picture) => picture.zoomBy(factor));
    this.draw();
  }

  fit() {
    this.pictures.forEach((picture) => picture.fit());
    this.draw();
  }

  toggleScreen() {
    if (document.fullscreenElement) document.exitFullscreen();
    else this.box.requestFullscreen().catch((error) => this.say(`No full screen: ${error.message}`, true));
  }

  // ---- what is seen

  draw() {
    this.mover.setAttribute("aria-pressed", this.moving);
    this.joiner.setAttribute("aria-pressed", this.model.get("together"));
    for (const [part, node] of Object.entries(this.toggles)) node.setAttribute("aria-pressed", this.shown.has(part));
    if (!this.seen) return;
    const width = this.pictures[0].canvas.clientWidth;
    const tallest = Math.max(...this.pictures.map(({ size }) => (width * size[1]) / size[0]));
    this.pictures.forEach((picture, side) => {
      picture.canvas.style.height = `${Math.round(Math.min(tallest, RESTING_SHARE * window.innerHeight))}px`;
      picture.canvas.classList.toggle("mmgsd-grab", this.moving || side === 1);
      picture.draw((context, place, unit) => this.paint(side, context, place, unit));
    });
  }

  paint(side, context, place, unit) {
    const { bitmaps, sizes } = this.seen;
    const hot = side === 1 && this.heat && this.shown.has("heatmap");
    drawImage(context, place, bitmaps[hot ? 2 : side], sizes[side]);
    if (hot) drawImage(context, place, this.heat, sizes[side], true);
    this.queries.forEach(({ xy, modes, said }, k) => {
      const { ellipses, matches } = this.answer.points[k];
      const colour = COLOURS[k % COLOURS.length];
      if (side === 0) return drawPixel(context, place, unit, colour, xy);
      const thick = (m) => (this.lit?.[0] === k && this.lit[1] === m ? 2 * unit : unit);
      if (this.shown.has("modes")) {
        const other = (m) => modes[m].answer !== undefined && modes[m].answer !== this.chosen + 1;
        const how = (m) => ({ hidden: isHidden(modes[m]), faint: said || other(m) });
        ellipses.forEach((mode, m) => drawMode(context, place, thick(m), colour, mode, modes[m].weight, how(m)));
      }
      if (this.shown.has("true matches")) matches.forEach((match) => drawCross(context, place, unit, colour, match));
    });
  }

  makeTable({ xy, modes, entropy, outside, said }, k) {
    const dot = () => make("span", { className: "mmgsd-dot", style: `background: ${COLOURS[k % COLOURS.length]}` });
    const bar = (value) => make("span", { className: "mmgsd-share" }, make("i", { style: `width: ${100 * value}%` }));
    const place = xy.map((value) => value.toFixed(0)).join(", ");
    const rest = ` at (${place}) · entropy ${entropy.toFixed(1)} nats · ${percent(outside)} outside the modes`;
    const why = said ? [make("div", { className: "mmgsd-why", textContent: said })] : [];
    const caption = [dot(), make("b", { textContent: `Point ${k + 1}` }), rest, ...why];
    const table = makeModes("mode", modes, caption, (value) => [bar(value), percent(value)]);
    table.tHead.rows[0].cells[5].title = "How probable a true match within 20 px is";
    const light = (lit) => () => {
      this.lit = lit;
      this.draw();
    };
    [...table.tBodies[0].rows].forEach((row, m) => {
      row.cells[0].prepend(dot());
      Object.assign(row, { onmouseenter: light([k, m]), onmouseleave: light(null) });
    });
    return table;
  }

  savePicture() {
    if (!this.seen) return;
    const [gap, sizes] = [8, this.seen.sizes];
    const height = Math.min(Math.max(sizes[0][1], sizes[1][1], 600), 1200);
    const widths = sizes.map(([w, h]) => Math.round((w * height) / h));
    const canvas = make("canvas", { width: widths[0] + gap + widths[1], height });
    const context = canvas.getContext("2d");
    context.fillStyle = "white";
    context.fillRect(0, 0, canvas.width, height);
    sizes.forEach((size, side) => {
      const x = side * (widths[0] + gap);
      context.save();
      context.beginPath();
      context.rect(x, 0, widths[side], height);
      context.clip();
      this.paint(side, context, { scale: height / size[1], x, y: 0 }, height / 500);
      context.restore();
    });
    canvas.toBlob((blob) => download(blob, "mmgsd.png"));
  }

  saveJson() {
    if (this.queries?.length) download(new Blob([this.answer.json, "\n"], { type: "application/json" }), "mmgsd.json");
  }

  saveMarks() {
    const marks = this.model.get("marks");
    if (marks === "[]") return this.say("Pin points on the left image first: shift + click.", true);
    download(new Blob([marks, "\n"], { type: "application/json" }), "index.json");
  }
}

function makeLegend(colours) {
  const bar = make("canvas", { width: 64, height: 10, style: "border-radius: 2px" });
  for (let k = 0; k < 64; k++) {
    const from = 3 * Math.round((255 * k) / 63);
    bar.getContext("2d").fillStyle = `rgb(${colours.subarray(from, from + 3).join()})`;
    bar.getContext("2d").fillRect(k, 0, 1, 10);
  }
  const mode = { x: 0, y: 0, major: 0, minor: 0, angle: -0.4 };
  const entries = [
    [sign((...where) => drawPixel(...where, [0, 0])), "asked pixel"],
    [sign((...where) => drawMode(...where, mode, 0.25)), "mode, larger with its weight"],
    [sign((...where) => drawMode(...where, { ...mode, major: 15, minor: 9 }, 0)), "its spread, 1 std"],
    [sign((...where) => drawMode(...where, mode, 0.25, { hidden: true })), "hidden there, where known"],
    [sign((...where) => drawCross(...where, [0, 0])), "true match, where known"],
    [bar, "heatmap of the last point, up to its maximum"],
  ];
  return make("div", { className: "mmgsd-legend" }, ...entries.map((entry) => make("span", {}, ...entry)));
}

function makeHelp() {
  const key = ([keys, does]) => make("span", {}, make("kbd", { textContent: keys }), ` ${does}`);
  return make("div", { className: "mmgsd-keys" }, ...HELP.map(key));
}

function render({ model, el }) {
  const explorer = new Explorer(model);
  el.append(explorer.box);
  return () => explorer.remove();
}

export default { render };
