// The X-ray view: grey images into canvases, the C-arm's controls, and what is counted.

const MOST_WAITING = 3; // images that wait for a frame
const CONTROLS = ["roadmap", "biplane", "which", "lao", "cran", "zoom", "rate", "dose"];

/** The images of one or two planes, and the bar below them. */
export class Fluoroscopy {
  constructor(connection) {
    this.connection = connection;
    this.pens = [0, 1].map((plane) => document.getElementById(`plane${plane}`).getContext("2d", { alpha: false }));
    this.pixels = this.pens.map((pen) => pen.createImageData(512, 512));
    this.words = this.pixels.map((pixels) => new Uint32Array(pixels.data.buffer));
    this.grey = new Uint32Array(256).map((_, value) => 0xff000000 | (value << 16) | (value << 8) | value);
    this.waiting = [[], []];
    this.images = 0;
    for (const id of CONTROLS) {
      this[id] = document.getElementById(id);
      this[id].addEventListener("change", () => this.changed(id));
    }
  }

  /** Keep an image until the next frame is drawn; of two that come between two frames both are shown, one after the other. */
  take(message) {
    const waiting = this.waiting[message.plane];
    waiting.push(message);
    if (waiting.length > MOST_WAITING) waiting.shift();
  }

  draw() {
    this.waiting.forEach((waiting, plane) => {
      const message = waiting.shift();
      if (!message) return;
      const words = this.words[plane], grey = message.grey;
      for (let i = 0; i < grey.length; i++) words[i] = this.grey[grey[i]];
      this.pens[plane].putImageData(this.pixels[plane], 0, 0);
      this.images += plane === 0 ? 1 : 0;
    });
  }

  changed(id) {
    const values = { roadmap: this.roadmap.checked, biplane: this.biplane.checked, zoom: Number(this.zoom.value), frames_per_s: Number(this.rate.value), dose: Number(this.dose.value) };
    const names = { rate: "frames_per_s" };
    if (id === "lao" || id === "cran") {
      const angles = this.last.angles_deg.map((pair) => [...pair]);
      angles[Number(this.which.value)] = [Number(this.lao.value), Number(this.cran.value)];
      this.connection.send("c_arm", { angles_deg: angles });
    } else if (id === "which") {
      this.fill();
    } else {
      const name = names[id] ?? id;
      this.connection.send("c_arm", { [name]: values[name] });
    }
    if (this[id].type === "checkbox" || this[id].tagName === "SELECT") this[id].blur();
  }

  angles() {
    return this.last?.angles_deg[Number(this.which.value)] ?? [0, 0];
  }

  fill() {
    const set = (input, value) => document.activeElement !== input && (input.value = value);
    [this.lao, this.cran].forEach((input, k) => set(input, this.angles()[k]));
    set(this.zoom, this.last.zoom);
    set(this.rate, this.last.frames_per_s);
    set(this.dose, this.last.dose);
    this.roadmap.checked = this.last.roadmap;
    this.biplane.checked = this.last.biplane;
  }

  /** Show what the X-ray unit says of itself, and where the target lies in its images. */
  show(xray, target) {
    target.forEach(([column, row], plane) => {
      const mark = document.getElementById(`mark${plane}`);
      mark.style.left = `${(column / 512) * 100}%`;
      mark.style.top = `${(row / 512) * 100}%`;
      mark.hidden = column < 0 || row < 0 || column > 512 || row > 512;
    });
    const changed = JSON.stringify([xray.angles_deg, xray.zoom, xray.biplane, xray.frames_per_s, xray.dose, xray.roadmap]);
    this.last = xray;
    if (changed !== this.filled) {
      this.filled = changed;
      this.fill();
      document.getElementById("planes").classList.toggle("two", xray.biplane);
      document.getElementById("plane1").parentElement.hidden = !xray.biplane;
    }
    const age = xray.age_s === null ? "no image yet" : xray.on ? "live" : `last image, ${xray.age_s.toFixed(1)} s old`;
    const what = xray.ready ? age : "the C-arm turns …";
    xray.angles_deg.forEach(([lao, cran], plane) => {
      const figure = document.getElementById(`plane${plane}`).parentElement;
      figure.classList.toggle("live", xray.on);
      put(`caption${plane}`, `${angleText(lao, cran)}   ${what}${xray.contrast ? "   contrast" : ""}`);
    });
    document.getElementById("pedal").classList.toggle("live", xray.on);
    const kerma = xray.kerma_ugy < 1000 ? `${xray.kerma_ugy.toFixed(0)} µGy` : `${(xray.kerma_ugy / 1000).toFixed(2)} mGy`;
    list("counts", { exposures: xray.frames, fluoroscopy: `${xray.seconds.toFixed(1)} s`, "air kerma, est.": kerma, background: xray.background });
  }
}

export function angleText(lao, cran) {
  const side = lao >= 0 ? `LAO ${lao}°` : `RAO ${-lao}°`;
  return cran === 0 ? side : `${side} ${cran > 0 ? "CRAN" : "CAUD"} ${Math.abs(cran)}°`;
}

/** Set the text of an element, if it is another one. */
export function put(id, text) {
  const element = document.getElementById(id);
  if (element.textContent !== text) element.textContent = text;
}

/** Fill a list of terms and values; only what changed is touched. */
export function list(id, values) {
  const box = document.getElementById(id);
  const names = Object.keys(values);
  if (box.dataset.names !== names.join()) {
    box.dataset.names = names.join();
    box.replaceChildren(...names.map((name) => {
      const row = document.createElement("div"), term = document.createElement("dt"), value = document.createElement("dd");
      term.textContent = name;
      row.append(term, value);
      return row;
    }));
  }
  names.forEach((name, i) => {
    const value = box.children[i].lastChild, text = String(values[name]);
    if (value.textContent !== text) value.textContent = text;
  });
}
