// The page: connects, hands each message to the view that shows it, and draws one frame after the other.
import { AutopilotBar } from "./autopilot.js";
import { Connection, fetchScene } from "./connection.js";
import { Fluoroscopy, list, put } from "./fluoroscopy.js";
import { GameBar } from "./game.js";
import { Hands } from "./hands.js";
import { ReplayBar } from "./replay.js";
import { Space } from "./space.js";

const page = { state: null, role: { drives: false }, space: null, frames: 0, written: 0 };
const TEXT_MS = 90; // between two updates of the page's text
window.cockpit = page; // for tests and the console

const handlers = {
  state: (message) => { page.state = message; },
  image: (message) => page.xray.take(message),
  belief: (message) => page.space.showBelief(message),
  role: (message) => showRole(message),
  result: (message) => page.game.scores(message.scores),
  notice: (message) => banner(message.text, true),
  error: (message) => { page.fatal = true; banner(message.text); },
  pong: (message) => page.pong?.(message.number),
};

function banner(text, note = false) {
  const box = document.getElementById("banner");
  box.hidden = !text;
  box.textContent = text ?? "";
  box.classList.toggle("note", note);
  clearTimeout(page.bannerTimer);
  if (note) page.bannerTimer = setTimeout(() => banner(null), 6000);
}

function showRole(role) {
  page.role = role;
  const chip = document.getElementById("role");
  chip.textContent = `${role.drives ? "you drive" : role.taken ? "you watch; another page drives" : "nobody drives"}, ${role.pages} page${role.pages > 1 ? "s" : ""}`;
  chip.classList.toggle("drives", role.drives);
  const button = document.getElementById("wheel");
  button.hidden = role.taken && !role.drives;
  button.textContent = role.drives ? "Let the wheel go" : "Take the wheel";
  button.onclick = () => { page.connection.send("wheel", { take: !role.drives }); button.blur(); };
}

function showForce(state) {
  const blind = !state.sight;
  let [value, limit] = [state.force_n, page.scene.force_limit_n];
  if (blind) { // of the drive that is nearest to its limit
    const loads = devices().map((device, k) => [Math.abs(state.drive_load[2 * k]), device.push_limit_n]);
    [value, limit] = loads.reduce((most, one) => (one[0] / one[1] > most[0] / most[1] ? one : most));
  }
  const share = value / limit, bar = document.querySelector("#force i");
  bar.style.width = `${Math.min(100, share * 80)}%`;
  bar.className = share >= 1 ? "over" : share > 0.6 ? "near" : "";
  document.querySelector("#force u").style.left = "80%";
  put("force-label", blind ? "Drive's load" : "Wall force");
  put("force-text", `${value.toFixed(3)} N`);
}

/** The wire, and the catheters around it from the inside out. */
function devices() {
  return [{ name: "wire", push_limit_n: page.scene.push_limit_n }, ...(page.scene.catheters ?? [])];
}

/** Where each device is and how its drive moves, in one row for a pair and three for a wire alone. */
function placesOf(state) {
  const speed = (k) => `${state.velocity[2 * k].toFixed(1)} mm/s, ${state.velocity[2 * k + 1].toFixed(1)} rad/s`;
  if (!state.catheters) {
    return { inserted: `${state.inserted_length_mm.toFixed(1)} mm`, rotation: `${state.rotation_deg.toFixed(0)}°`, drive: speed(0) };
  }
  const rows = [state, ...state.catheters].map((one, k) => [
    devices()[k].name, `${one.inserted_length_mm.toFixed(1)} mm, ${one.rotation_deg.toFixed(0)}°, ${speed(k)}`,
  ]);
  return Object.fromEntries(rows);
}

/** Where the wire's tip is, and how far along the vessel those of catheters are. */
function tipsOf(state) {
  const around = (state.catheter_tips_mm ?? []).map((at, k) => `, ${devices()[k + 1].name} ${at.toFixed(1)} mm`);
  return `${state.section}, ${state.tip_mm.toFixed(1)} mm${around.join("")}`;
}

function showFigures(state) {
  const slips = state.slip.some((value) => Math.abs(value) > 1e-6);
  list("figures", {
    time: `${state.time_s.toFixed(1)} s`,
    ...placesOf(state),
    tip: state.sight ? tipsOf(state) : "hidden",
    "peak force": state.sight ? `${state.peak_force_n.toFixed(3)} N` : "hidden",
    state: !state.valid ? "simulation failed" : slips ? "the drive slips" : state.stopped === "silence" ? "stopped: 200 ms without a message; let the keys go if it stays so" : state.stopped ? `stopped: ${state.stopped}` : "ready",
  });
}

function showText(state) {
  page.xray.show(state.xray, state.target_px);
  showForce(state);
  showFigures(state);
  page.autopilot?.show(state.autopilot, state.target);
  if (state.replay) page.replay.show(state.replay, state.time_s);
  page.hands.showHeld(state.mode === "drive");
  if (state.game) page.game.show(state.game);
  page.space.believe(Boolean(page.autopilot?.shown.checked));
  document.getElementById("blind").hidden = state.sight;
}

function frame(now) {
  requestAnimationFrame(frame);
  const fresh = page.state && page.state !== page.shown;
  if (fresh) {
    page.shown = page.state;
    page.space.show(page.state);
  }
  if (page.shown && now - page.written > TEXT_MS) {
    page.written = now;
    showText(page.shown);
  }
  page.xray.draw();
  if (page.shown?.sight !== false) page.frames += page.space.draw(now);
}

async function start() {
  try {
    page.scene = await fetchScene();
  } catch (error) {
    banner(`The page cannot be shown: ${error.message}`);
    return;
  }
  put("patient", [page.scene.name, page.scene.wire, ...devices().slice(1).map((one) => `in ${one.name}`)].join(", "));
  put("scale-text", `wall force, 0 to ${page.scene.force_limit_n} N`);
  page.connection = new Connection(handlers, (why) => { if (!page.fatal) banner(why); });
  page.xray = new Fluoroscopy(page.connection);
  page.space = new Space(document.getElementById("scene"), page.scene, (place) => page.connection.send("target", place));
  page.space.buttons(document.getElementById("cameras"), () => page.xray.angles());
  page.game = new GameBar(page.connection);
  page.replay = new ReplayBar(page.connection);
  if (page.scene.policies) page.autopilot = new AutopilotBar(page.connection, page.scene);
  page.hands = new Hands(page.connection, devices(), () => page.role.drives, () => Boolean(page.autopilot?.drives), () => page.space.wake());
  requestAnimationFrame(frame);
}

start();
