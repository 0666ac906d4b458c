// Keyboard, gamepad and a pad for touch: what is held becomes a velocity, sent at every change and every 50 ms while anything is held.

const HEARTBEAT_MS = 50;
const SPEEDS = { fine: [1, 0.4], usual: [8, 2.5], fast: [30, 9] }; // mm/s, rad/s
const KEYS = {
  KeyW: [1, 0], ArrowUp: [1, 0], KeyS: [-1, 0], ArrowDown: [-1, 0],
  KeyD: [0, 1], ArrowRight: [0, 1], KeyA: [0, -1], ArrowLeft: [0, -1],
};
const DEAD = 0.15;

/** Turns what is held into messages. The hand holds one of the `devices`, the wire first, or all at once. `drives()` tells whether the page drives, `policyDrives()` whether its autopilot does; `wake()` is called as a motion begins. */
export class Hands {
  constructor(connection, devices, drives, policyDrives, wake) {
    this.connection = connection;
    this.devices = devices;
    this.wake = wake;
    this.drives = drives;
    this.policyDrives = policyDrives;
    this.held = new Set();
    this.choice = 0;
    this.addChoices();
    this.pedalHeld = new Set();
    this.sent = this.rest();
    this.pedalSent = false;
    this.before = [];
    addEventListener("keydown", (event) => this.key(event, true));
    addEventListener("keyup", (event) => this.key(event, false));
    addEventListener("blur", () => this.release());
    document.addEventListener("visibilitychange", () => document.hidden && this.release());
    this.button("pedal", "pointerdown", () => this.pedal("mouse", true));
    for (const end of ["pointerup", "pointerleave", "pointercancel"]) this.button("pedal", end, () => this.pedal("mouse", false));
    this.touchPad(document.getElementById("pad"));
    this.button("contrast", "click", () => this.connection.send("contrast"));
    setInterval(() => this.beat(), HEARTBEAT_MS);
  }

  /** Let a pad drive: a finger's way from its middle, up to push and sideways to turn, is a share of the usual speed. */
  touchPad(pad) {
    this.pad = [0, 0];
    const knob = pad.querySelector("i");
    const set = (along, turn) => {
      this.pad = [along, turn];
      pad.classList.toggle("held", along !== 0 || turn !== 0);
      knob.style.transform = `translate(${turn * 44}px, ${-along * 44}px)`;
      this.update();
    };
    const share = (way) => (Math.abs(way) < DEAD ? 0 : Math.max(-1, Math.min(1, way)));
    const move = (event) => {
      const box = pad.getBoundingClientRect();
      set(share(1 - 2 * (event.clientY - box.top) / box.height), share(2 * (event.clientX - box.left) / box.width - 1));
    };
    pad.addEventListener("pointerdown", (event) => { event.preventDefault(); pad.setPointerCapture(event.pointerId); move(event); });
    pad.addEventListener("pointermove", (event) => pad.hasPointerCapture(event.pointerId) && move(event));
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) pad.addEventListener(end, () => set(0, 0));
    this.letGo = () => set(0, 0);
  }

  rest() {
    return this.devices.flatMap(() => [0, 0]);
  }

  /** What the hand may hold: each device, and all of them if there are several. */
  choices() {
    const names = this.devices.map((device) => device.name);
    return names.length > 1 ? [...names, names.length > 2 ? "all" : "both"] : names;
  }

  /** Take another device into the hand; keys that are pressed are let go, so that they do not move it. */
  hold(choice) {
    this.held.clear();
    this.choice = choice % this.choices().length;
    this.showHeld();
  }

  /** Add a button for each choice. */
  addChoices() {
    const label = document.createElement("span");
    label.innerHTML = "in hand <kbd>Q</kbd>";
    this.choiceButtons = this.choices().map((name, choice) => {
      const button = document.createElement("button");
      button.textContent = name;
      button.onclick = () => { this.hold(choice); button.blur(); };
      return button;
    });
    document.getElementById("holds").append(label, ...this.choiceButtons);
    this.showHeld();
  }

  /** Show what the hand holds, if there is a choice and a hand. */
  showHeld(driven = true) {
    document.getElementById("holds").hidden = this.devices.length === 1 || !driven;
    this.choiceButtons.forEach((button, choice) => button.classList.toggle("on", choice === this.choice));
  }

  button(id, event, act) {
    document.getElementById(id).addEventListener(event, act);
  }

  key(event, down) {
    if (event.target.matches?.("input[type=number], select")) return;
    if (event.ctrlKey || event.metaKey) return;
    this.fine = event.altKey;
    this.fast = event.shiftKey;
    const repeated = event.repeat;
    if (event.code in KEYS) {
      down ? this.held.add(event.code) : this.held.delete(event.code);
    } else if (event.code === "KeyX") {
      if (!repeated) this.pedal("key", down);
    } else if (event.code === "KeyC") {
      if (down && !repeated) this.connection.send("contrast");
    } else if (event.code === "KeyQ") {
      if (down && !repeated) this.hold(this.choice + 1);
    } else if (event.code === "Space") {
      if (down) this.stop();
    } else if (!event.code.startsWith("Shift") && !event.code.startsWith("Alt")) {
      return;
    }
    event.preventDefault();
    this.update();
  }

  stop() {
    this.held.clear();
    this.letGo();
    this.connection.send("autopilot", { action: "stop" });
    this.send(this.rest());
  }

  release() {
    this.held.clear();
    this.letGo();
    for (const name of [...this.pedalHeld]) this.pedal(name, false);
    this.update();
  }

  pedal(name, down) {
    down ? this.pedalHeld.add(name) : this.pedalHeld.delete(name);
    const pressed = this.pedalHeld.size > 0;
    if (pressed !== this.pedalSent && this.drives()) {
      this.pedalSent = pressed;
      this.connection.send("pedal", { down: pressed });
    }
  }

  wanted() {
    let [along, turn] = this.pad;
    for (const code of this.held) {
      along += KEYS[code][0];
      turn += KEYS[code][1];
    }
    let speed = this.fast ? "fast" : this.fine ? "fine" : "usual";
    const pad = [...(navigator.getGamepads?.() ?? [])].find((one) => one?.connected);
    if (pad) {
      const stick = (value) => (Math.abs(value ?? 0) < DEAD ? 0 : value);
      along ||= -stick(pad.axes[1]);
      turn ||= stick(pad.axes[2]) || stick(pad.axes[0]);
      if (pad.buttons[4]?.pressed) speed = "fine";
      if (pad.buttons[5]?.pressed) speed = "fast";
      this.pedal("pad", Boolean(pad.buttons[7]?.pressed));
      const contrast = Boolean(pad.buttons[0]?.pressed);
      if (contrast && !this.padContrast) this.connection.send("contrast");
      this.padContrast = contrast;
      const next = Boolean(pad.buttons[3]?.pressed);
      if (next && !this.padNext) this.hold(this.choice + 1);
      this.padNext = next;
    }
    const [v, w] = SPEEDS[speed];
    const velocity = [Math.sign(along) * Math.min(Math.abs(along), 1) * v, Math.sign(turn) * Math.min(Math.abs(turn), 1) * w];
    return this.devices.flatMap((_, device) => (device === this.choice || this.choice === this.devices.length ? velocity : [0, 0]));
  }

  update() {
    const wanted = this.wanted();
    if (wanted.some((value, i) => value !== this.sent[i])) this.send(wanted);
  }

  beat() {
    this.update();
    if (this.sent.some(Boolean) || this.policyDrives()) this.send(this.sent);
    if (this.pedalSent && this.drives()) this.connection.send("pedal", { down: true });
  }

  send(velocity) {
    if (!this.sent.some(Boolean)) this.wake();
    this.sent = velocity;
    const [translation, rotation, ...others] = velocity;
    const catheters = this.devices.slice(1).map((_, k) => [others[2 * k], others[2 * k + 1]]);
    if (this.drives()) this.connection.send("drive", { translation, rotation, ...(catheters.length && { catheters }) });
  }
}
