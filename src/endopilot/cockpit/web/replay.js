// The time slider of a replay.
import { put } from "./fluoroscopy.js";

/** The bar in the element `replay`. */
export class ReplayBar {
  constructor(connection) {
    const bar = document.getElementById("replay");
    this.play = document.createElement("button");
    this.play.id = "play";
    this.play.onclick = () => { connection.send("replay", { playing: !this.playing }); this.play.blur(); };
    this.slider = document.createElement("input");
    Object.assign(this.slider, { type: "range", id: "slider", min: 0, step: 0.05 });
    this.slider.oninput = () => connection.send("replay", { at_s: Number(this.slider.value), playing: false });
    this.slider.onchange = () => this.slider.blur();
    const text = document.createElement("span");
    text.id = "replay-text";
    bar.append(this.play, this.slider, text);
  }

  show({ title, seconds, ready_s, playing, failure }, time) {
    this.playing = playing;
    document.getElementById("replay").hidden = false;
    document.getElementById("autopilot").hidden = true;
    this.play.textContent = playing ? "❚❚ Pause" : "▶ Play";
    this.slider.max = seconds;
    if (document.activeElement !== this.slider) this.slider.value = time;
    const loading = ready_s + 0.1 < seconds && !failure ? `, driven again up to ${ready_s.toFixed(0)} s` : "";
    put("replay-text", `${title}: ${time.toFixed(1)} of ${seconds.toFixed(1)} s${loading}${failure ? `. ${failure}` : ""}`);
  }
}
