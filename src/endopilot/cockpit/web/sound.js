// The wall's force as a tone, on request: louder and higher as the force nears its limit.

/** A tone that is switched on by a checkbox. */
export class Sound {
  constructor(box) {
    box.addEventListener("change", () => {
      box.checked ? this.start() : this.stop();
      box.blur();
    });
  }

  start() {
    this.context = new AudioContext();
    this.tone = this.context.createOscillator();
    this.volume = this.context.createGain();
    this.volume.gain.value = 0;
    this.tone.connect(this.volume).connect(this.context.destination);
    this.tone.start();
  }

  stop() {
    this.context?.close();
    this.context = null;
  }

  /** Sound a force, given as a share of its limit. */
  set(share) {
    if (!this.context) return;
    const now = this.context.currentTime;
    this.volume.gain.setTargetAtTime(share < 0.05 ? 0 : Math.min(0.25, 0.25 * share), now, 0.03);
    this.tone.frequency.setTargetAtTime(220 * 2 ** (2 * Math.min(share, 1.5)), now, 0.03);
  }
}
