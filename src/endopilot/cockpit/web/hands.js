// Keyboard and gamepad: what is held becomes a velocity, sent at every change and every 50 ms while anything is held.

const HEARTBEAT_MS = 50;
const SPEEDS = { fine: [1, 0.4], usual: [8, 2.5], fast: [30, 9] }; // mm/s, rad/s
const KEYS = {
  KeyW: [1, 0], ArrowUp: [1, 0], KeyS: [-1, 0], ArrowDown: [-1, 0],
  KeyD: [0, 1], ArrowRight: [0, 1], KeyA: [0, -1], ArrowLeft: [0, -1],
};
const DEAD = 0.15;

/** Turns what is held into messages. `drives()` tells whether the page drives, `policyDrives()` whether its autopilot does; `wake()` is called as a motion begins. */
export class Hands {
  constructor(connection, drives, policyDrives, wake) {
    this.connection = connection;
    this.wake = wake;
    this.drives = drives;
    this.policyDrives = policyDrives;
    this.held = new Set();
    this.pedalHeld = new Set();
    this.sent = [0, 0];
    this.pedalSent = false;
    this.before = [];
    addEventListener("keydown", (event) => this.key(event, true));
    addEventListener("keyup", (event) => this.key(event, false));
    addEventListener("blur", () => this.release());
    document.addEventListener("visibilitychange", () => document.hidden && this.release());
    this.button("pedal", "pointerdown", () => this.pedal("mouse", true));
    for (const end of ["pointerup", "pointerleave", "pointercancel"]) this.button("pedal", end, () => this.pedal("mouse", false));
    this.button("contrast", "click", () => this.connection.send("contrast"));
    setInterval(() => this.beat(), HEARTBEAT_MS);
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
    this.connection.send("autopilot", { action: "stop" });
    this.send([0, 0]);
  }

  release() {
    this.held.clear();
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
    let along = 0, turn = 0;
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
    }
    const [v, w] = SPEEDS[speed];
    return [Math.sign(along) * Math.min(Math.abs(along), 1) * v, Math.sign(turn) * Math.min(Math.abs(turn), 1) * w];
  }

  update() {
    const wanted = this.wanted();
    if (wanted[0] !== this.sent[0] || wanted[1] !== this.sent[1]) this.send(wanted);
  }

  beat() {
    this.update();
    if (this.sent[0] || this.sent[1] || this.policyDrives()) this.send(this.sent);
    if (this.pedalSent && this.drives()) this.connection.send("pedal", { down: true });
  }

  send([translation, rotation]) {
    if (!this.sent[0] && !this.sent[1]) this.wake();
    this.sent = [translation, rotation];
    if (this.drives()) this.connection.send("drive", { translation, rotation });
  }
}
