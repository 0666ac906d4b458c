// The autopilot's bar: policy, target, start, pause, take over; the lamp that says when and why it asks for X-ray.
import { put } from "./fluoroscopy.js";

const WORDS = {
  off: "You drive by hand.", thinking: "It thinks; time stands still.", drives: "It drives.", paused: "It is paused.",
  watches: "You drive; it watches.", reached: "The target is reached.", failed: "It failed.",
};

/** The bar in the element `autopilot`. */
export class AutopilotBar {
  constructor(connection, scene) {
    this.connection = connection;
    this.bar = document.getElementById("autopilot");
    this.policy = this.select("policy", scene.policies, "agent");
    this.target = this.select("target", ["…", ...scene.sections.map((section) => section.name)]);
    this.target.onchange = () => this.target.value !== "…" && connection.send("target", { section: this.target.value });
    this.go = this.button("Start", () => this.act());
    this.pause = this.button("Pause", () => connection.send("autopilot", { action: this.status === "paused" ? "resume" : "pause" }));
    this.stop = this.button("Take over", () => connection.send("autopilot", { action: "stop" }));
    this.lamp = document.createElement("span");
    this.lamp.className = "lamp";
    this.text = document.createElement("span");
    this.text.id = "autopilot-text";
    this.bar.append(this.lamp, this.text);
    this.shown = this.check("beliefs", "what it believes");
  }

  select(name, values, chosen) {
    const label = document.createElement("label"), box = document.createElement("select");
    box.id = `autopilot-${name}`;
    box.append(...values.map((value) => new Option(value, value, value === chosen, value === chosen)));
    box.addEventListener("change", () => box.blur());
    label.append(`${name} `, box);
    this.bar.append(label);
    return box;
  }

  button(name, act) {
    const button = document.createElement("button");
    button.textContent = name;
    button.id = `autopilot-${name.toLowerCase().replace(" ", "-")}`;
    button.onclick = () => { act(); button.blur(); };
    this.bar.append(button);
    return button;
  }

  check(name, text) {
    const label = document.createElement("label"), box = document.createElement("input");
    box.type = "checkbox";
    box.checked = true;
    box.id = name;
    box.addEventListener("change", () => box.blur());
    label.append(box, ` ${text}`);
    this.bar.append(label);
    return box;
  }

  act() {
    this.connection.send("autopilot", { action: "start", policy: this.policy.value });
    this.status = "thinking"; // from now on the page says that it is there
  }

  /** Whether a policy drives, so that the page must say that it is there. */
  get drives() {
    return this.status === "drives" || this.status === "thinking";
  }

  /** Show the policy's part of a state. */
  show(autopilot, target) {
    if (!autopilot) return;
    this.status = autopilot.status;
    this.go.textContent = autopilot.status === "watches" ? "Hand back" : "Start";
    this.go.disabled = this.drives;
    this.pause.textContent = autopilot.status === "paused" ? "Go on" : "Pause";
    this.pause.disabled = !(this.drives || autopilot.status === "paused");
    this.stop.disabled = !(this.drives || autopilot.status === "paused");
    this.lamp.classList.toggle("on", Boolean(autopilot.asks));
    const band = autopilot.half_width?.[0] ?? null;
    const believed = autopilot.believed_mm === null ? "" : ` It believes the tip at ${autopilot.believed_mm.toFixed(1)}${band === null ? "" : ` ± ${band.toFixed(1)}`} mm.`;
    const asks = autopilot.asks ? ` X-ray: ${autopilot.asks}.` : "";
    put("autopilot-text", autopilot.failure || WORDS[autopilot.status] + asks + believed);
    this.text.classList.toggle("ask", Boolean(autopilot.asks || autopilot.failure));
    if (target && document.activeElement !== this.target) this.target.value = target.section;
  }
}
