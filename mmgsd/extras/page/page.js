// The page: the explorer's pictures and marks, answered in the browser itself. Text from files only ever becomes text.

import { fitInputSize, match, resize } from "./answer.js";

const SHOWN_PX = 1600; // longer side of what is drawn
const [FADED, LOW, HIGH] = [0.75, 0.15, 0.85]; // brightness under the heatmap, and the greys it is stretched to
const RUNTIMES = { WebGPU: ["webgpu", "ort.webgpu.min.mjs"], WebAssembly: ["wasm", "ort.wasm.min.mjs"] };

class Page {
  constructor(model) {
    this.model = model;
    this.images = [null, null];
    this.next = 0; // the side that a sample or a pasted picture goes to
    this.build();
    document.addEventListener("paste", (event) => this.openFiles([...event.clipboardData.files]));
    addEventListener("resize", () => this.draw());
  }

  build() {
    const button = (textContent, title, onclick) => make("button", { type: "button", textContent, title, onclick });
    this.pictures = ["left", "right"].map((word, side) => {
      const picture = new Picture(word, (files) => this.openFiles(files, side));
      picture.name.parentNode.insertBefore(
        button("camera", `A picture by the camera as the ${word} one`, () => this.openCamera(side)),
        picture.input,
      );
      return picture;
    });
    const { canvas } = this.pictures[0];
    for (const kind of ["pointerdown", "pointermove"]) canvas.addEventListener(kind, (event) => this.onPointer(event));
    this.line = make("p", { className: "mmgsd-line", ariaLive: "polite" });
    this.tables = make("div", { className: "mmgsd-tables" });
    const thumbnail = (file) => {
      const image = make("img", { src: file, alt: file.split("/").pop(), loading: "lazy" });
      const node = make("button", { type: "button", title: "As the left picture, the next one as the right" }, image);
      return Object.assign(node, { onclick: () => this.openSample(file) });
    };
    const text =
      `Tap or drag in the left picture: the right one shows every place that matches (${this.model.name}). ` +
      "Choose, drop, paste or take pictures of your own; they stay on this device.";
    document.body.append(
      make(
        "div",
        { className: "mmgsd-explorer" },
        make("p", { textContent: text }),
        make("div", { className: "mmgsd-pictures" }, ...this.pictures.map(({ box }) => box)),
        this.line,
        this.tables,
        make(
          "div",
          { className: "mmgsd-samples", hidden: !this.model.samples.length },
          ...this.model.samples.map(thumbnail),
        ),
      ),
    );
  }

  // ---- pictures

  async openFiles(files, side = this.next) {
    const chosen = files.filter(({ type, size }) => size && (type === "" || type.startsWith("image/"))).slice(0, 2);
    if (files.length && !chosen.length) this.say(`${files[0].name} is no picture.`, true);
    for (const [k, file] of chosen.entries()) await this.open(file, file.name, chosen.length === 2 ? k : side);
  }

  async openSample(file, side = this.next) {
    await this.open(await (await fetch(file)).blob(), file.split("/").pop(), side);
  }

  async open(blob, name, side) {
    let image;
    try {
      image = readImage(await createImageBitmap(blob), name);
    } catch (error) {
      return this.say(`${name} cannot be read as a picture here (${error.message}): save it as JPEG or PNG.`, true);
    }
    [this.images[side], this.answer, this.next] = [image, null, 1 - side];
    if (side === 0) this.xy = null;
    const picture = this.pictures[side];
    picture.size = image.size;
    picture.name.textContent = picture.name.title = name;
    this.update();
  }

  async openCamera(side) {
    let stream;
    try {
      stream = await navigator.mediaDevices.getUserMedia({
        video: { facingMode: "environment", width: { ideal: 1920 } },
      });
    } catch {
      // no camera, no permission, or an address that is not https: a phone's own camera is asked by the file field
      return Object.assign(
        make("input", {
          type: "file",
          accept: "image/*",
          capture: "environment",
          onchange: ({ target }) => this.openFiles([...target.files], side),
        }),
      ).click();
    }
    const video = make("video", { srcObject: stream, autoplay: true, muted: true, playsInline: true });
    const take = make("button", { type: "button", textContent: "take" });
    const dialog = make("dialog", {}, video, take);
    take.onclick = async () => {
      const canvas = make("canvas", { width: video.videoWidth, height: video.videoHeight });
      canvas.getContext("2d").drawImage(video, 0, 0);
      dialog.close();
      canvas.toBlob((blob) => this.open(blob, "camera", side));
    };
    dialog.onclose = () => {
      stream.getTracks().forEach((track) => track.stop());
      dialog.remove();
    };
    this.line.parentNode.append(dialog);
    dialog.showModal();
  }

  // ---- questions

  onPointer(event) {
    if (event.type === "pointerdown") event.target.setPointerCapture(event.pointerId);
    const xy = event.buttons && event.isPrimary ? this.pictures[0].toPixel(event) : null;
    if (!xy || !this.images[0]) return;
    this.xy = xy;
    this.update();
  }

  update() {
    // have what is missing computed
    this.draw();
    this.stale = true;
    this.working ??= this.work()
      .catch((error) => this.say(`It did not work: ${error.message}`, true))
      .finally(() => {
        this.working = null;
      });
  }

  async work() {
    // of a drag only the latest place: it never lags
    this.session ??= await this.openSession();
    while (this.stale) {
      this.stale = false;
      const images = [...this.images];
      for (const image of images.filter(Boolean)) image.outputs ??= await this.describe(image);
      if (this.stale) continue;
      if (images.every(Boolean) && this.xy) this.answerFor(images);
      else this.say(images.every(Boolean) ? "Tap in the left picture." : "Choose two pictures.");
    }
  }

  answerFor(images) {
    const start = performance.now();
    this.answer = match(...images, this.xy, this.model);
    const { said } = this.answer;
    this.say(said || `Answered in ${(performance.now() - start).toFixed(0)} ms by ${this.runtime}.`, Boolean(said));
    this.draw();
  }

  async openSession() {
    const adapter = await navigator.gpu?.requestAdapter().catch(() => null);
    const fast = adapter && !(adapter.info?.isFallbackAdapter ?? adapter.isFallbackAdapter); // one in software is slower
    for (const [name, [provider, script]] of Object.entries(RUNTIMES).slice(fast ? 0 : 1)) {
      try {
        this.say(`Loading the network for ${name}, once: then it works offline.`);
        const ort = await import(`./ort/${script}`);
        ort.env.wasm.wasmPaths = new URL("ort/", document.baseURI).href;
        const session = await ort.InferenceSession.create("model.onnx", { executionProviders: [provider] });
        [this.runtime, this.Tensor] = [name, ort.Tensor];
        await this.check(session);
        return session;
      } catch (error) {
        if (name === "WebAssembly") throw error;
        console.warn(`${name} cannot be used: ${error.message}`);
      }
    }
  }

  async check(session) {
    // against what the library's own runtime has for a made-up picture
    const {
      check: { factor, modulus, step, values, tolerance },
      least_px: side,
    } = this.model;
    const pixels = Float32Array.from({ length: 3 * side ** 2 }, (_, k) => ((k * factor) % modulus) / modulus);
    const {
      descriptors: { data },
    } = await this.run(session, pixels, [side, side]);
    if (!values.every((value, k) => Math.abs(data[k * step] - value) <= tolerance))
      throw new Error("it computes other descriptors");
  }

  run(session, pixels, [width, height]) {
    return session.run({ image: new this.Tensor("float32", pixels, [1, 3, height, width]) });
  }

  async describe(image) {
    this.say("Looking at the pictures.");
    await new Promise((resolve) => setTimeout(resolve)); // the words are drawn
    const size = fitInputSize(image.size, this.model);
    const found = await this.run(this.session, resize(image.pixels, image.size, size), size);
    const plane = ([name, { data, dims }]) => [name, { data, shape: dims.length === 4 ? dims.slice(1) : dims }];
    return Object.fromEntries(Object.entries(found).map(plane));
  }

  // ---- what is seen

  say(text, wrong = false) {
    this.line.textContent = text;
    this.line.classList.toggle("mmgsd-error", wrong);
  }

  draw() {
    this.pictures.forEach((picture, side) => picture.draw((...how) => this.images[side] && this.paint(side, ...how)));
    const { xy, modes } = this.answer ?? {};
    const caption = () => `Pixel (${xy.map((value) => value.toFixed(0)).join(", ")})`;
    this.tables.replaceChildren(...(this.answer ? [makeModes("match", modes, [caption()])] : []));
  }

  paint(side, context, place, unit) {
    const {
      answer,
      images: {
        [side]: { shown, faded, size },
      },
    } = this;
    drawImage(context, place, side && answer ? faded : shown, size);
    if (side === 0) return this.xy && drawPixel(context, place, unit, COLOURS[0], this.xy);
    if (!answer) return;
    const most = answer.heat.reduce((a, b) => Math.max(a, b));
    const heat = answer.heat.map((value) => 255 * Math.sqrt(value / most));
    const [rows, columns] = answer.shape;
    const colours = Uint8Array.from(this.model.heat_colours.flat());
    drawImage(
      context,
      place,
      makeHeat({ heat: Uint8Array.from(heat), heat_size: [columns, rows] }, colours),
      size,
      true,
    );
    answer.modes.forEach((mode) => {
      drawMode(context, place, unit, COLOURS[0], mode.ellipse, mode.weight, { faint: Boolean(answer.said) });
      if (!(mode.visible < this.model.likely)) drawPixel(context, place, 0.8 * unit, COLOURS[0], mode.xy); // hidden: hollow
    });
  }
}

function readImage(bitmap) {
  // its pixels, what is drawn of it, and that in stretched greys
  const size = [bitmap.width, bitmap.height];
  const paint = (width, height) => {
    const canvas = make("canvas", { width, height });
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.imageSmoothingQuality = "high";
    context.drawImage(bitmap, 0, 0, width, height);
    return [canvas, context];
  };
  const scale = Math.min(1, SHOWN_PX / Math.max(...size));
  const small = size.map((side) => Math.max(1, Math.round(side * scale)));
  const [shown] = paint(...small);
  const [faded, context] = paint(...small);
  const grey = context.getImageData(0, 0, ...small);
  const levels = Float32Array.from(
    { length: grey.data.length / 4 },
    (_, k) => (grey.data[4 * k] + grey.data[4 * k + 1] + grey.data[4 * k + 2]) / 3,
  );
  const sorted = levels.filter((_, k) => k % 9 === 0).sort();
  const [low, high] = [0.01, 0.99].map((share) => sorted[Math.floor(share * (sorted.length - 1))]);
  levels.forEach((level, k) => {
    const stretched = LOW + (HIGH - LOW) * Math.min(Math.max((level - low) / Math.max(high - low, 1), 0), 1);
    grey.data.fill(255 * FADED * stretched, 4 * k, 4 * k + 3);
  });
  context.putImageData(grey, 0, 0);
  const pixels = paint(...size)[1].getImageData(0, 0, ...size).data;
  bitmap.close();
  return { size, shown, faded, pixels };
}

async function prepareOffline() {
  // once: only what the worker answers has the headers for several threads
  if (!navigator.serviceWorker) return; // an address that is neither https nor this machine's
  try {
    await navigator.serviceWorker.register("worker.js");
    await navigator.serviceWorker.ready;
    if (crossOriginIsolated || sessionStorage.getItem("mmgsd")) return;
    sessionStorage.setItem("mmgsd", "reloaded");
  } catch (error) {
    return console.warn(`It will not work offline: ${error.message}`);
  }
  location.reload();
  await new Promise(() => {});
}

await prepareOffline();
const page = new Page(await (await fetch("model.json")).json());
for (const [side, file] of page.model.samples.slice(0, 2).entries()) await page.openSample(file, side);
page.update();
