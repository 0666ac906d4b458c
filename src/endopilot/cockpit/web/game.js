// A task of the ladder: its start, the time that is left, and the scores at its end.

const ROWS = [
  ["safe success", (score) => (score.success && score.safe ? "yes" : "no")],
  ["target reached", (score) => (score.success ? "yes" : `no (${score.reason})`)],
  ["time", (score) => `${score.seconds.toFixed(1)} s`],
  ["exposures", (score) => score.exposures],
  ["peak force", (score) => `${score.peak_force_n.toFixed(3)} N`],
];

/** The bar in the element `game`. */
export class GameBar {
  constructor(connection) {
    this.bar = document.getElementById("game");
    this.text = document.createElement("span");
    this.start = document.createElement("button");
    this.start.id = "game-start";
    this.start.className = "big";
    this.start.textContent = "Start the clock";
    this.start.onclick = () => { connection.send("game", { action: "start" }); this.start.blur(); };
    this.table = document.createElement("table");
    this.table.id = "scores";
    this.bar.append(this.text, this.start, this.table);
  }

  show(game) {
    this.bar.hidden = false;
    document.getElementById("autopilot").hidden = game.phase !== "over";
    this.start.hidden = game.phase !== "waits";
    const text = `Level ${game.level}: ${game.title}. ${game.phase === "over" ? "It is over." : `${game.left_s.toFixed(1)} s left.`}`;
    if (this.text.textContent !== text) this.text.textContent = text;
  }

  scores({ you, rival, agent, failure }) {
    const columns = [["", ...ROWS.map(([name]) => name)], ["you", ...ROWS.map(([, of]) => of(you))]];
    columns.push([rival, ...ROWS.map(([, of]) => (agent ? of(agent) : failure ? "–" : "it drives …"))]);
    this.table.replaceChildren(...columns.map((cells) => {
      const row = document.createElement("tr");
      row.append(...cells.map((cell, i) => {
        const box = document.createElement(i && cells[0] ? "td" : "th");
        box.textContent = cell;
        return box;
      }));
      return row;
    }));
  }
}
