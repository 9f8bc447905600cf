// Guided calibration: the board in the live picture, what is missing, the outcome.
import { BoardPicture, Coverage } from "/board.js";
import { quoted } from "/controls.js";
import { set } from "/state.js";

const $ = (id) => document.getElementById(id);
const SETTLED_MS = 300; // advice that changes quicker is not read
const TAKEN_MS = 1500; // how long a view that was taken is told
const EDGES = ["left", "right", "top", "bottom"];
const NOTHING = { phase: "idle", run: 0, by: 0, sentence: "", board: null, guidance: null, glance: null, outcome: null };
const TITLES = { idle: "The board", failed: "The board", running: "What is missing", done: "The camera" };
// Of a gauge, on 16 x 16.
const ICONS = {
  views: "M2 4h9v9H2z M5 4V2h9v9h-3",
  coverage: "M2 3h12v10H2z M2 8h12 M8 3v10",
  sideways: "M3 2l10 3v6L3 14z",
  forward: "M5 3h6l3 10H2z",
  precision: "M8 2v12 M2 8h12 M8 5a3 3 0 1 0 .01 0",
  distance: "M2 8h12 M5 5L2 8l3 3 M11 5l3 3-3 3",
};

function element(name, properties = {}, children = []) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

function icon(name) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  svg.setAttribute("viewBox", "0 0 16 16");
  svg.setAttribute("aria-hidden", "true");
  path.setAttribute("d", ICONS[name] ?? "");
  svg.append(path);
  return svg;
}

export class Calibration {
  constructor(say, seen) {
    this.say = say;
    // Apart from other orders' numbers, and from those of other pages: the console tells all of them who has begun.
    this.id = 0x4000_0000 + Math.floor(Math.random() * 0x3000_0000);
    this.begun = 0;
    this.prefix = "cairn";
    this.picture = new BoardPicture($("board"), $("board-empty"), seen);
    this.coverage = new Coverage($("coverage"));
    this.gauges = new Map();
    this.state = NOTHING;
    $("board-form").addEventListener("submit", (event) => {
      event.preventDefault();
      // The return key submits while the button is disabled, too.
      if (this.busy) return;
      this.begun = this.order({ do: "start", board: this.board() });
    });
    $("board-form").addEventListener("input", () => this.shell());
    this.buttons();
    this.shell();
  }

  /** As the form says it. */
  board() {
    const square = Number($("board-square").value);
    return { columns: Number($("board-columns").value), rows: Number($("board-rows").value), square_m: square > 0 ? square / 1000 : null, lens: $("board-lens").value };
  }

  order(action) {
    this.id += 1;
    this.busy = true;
    set($("board-answer"), "");
    if (!this.say({ calibrate: { id: this.id, action } })) this.reply({ id: this.id, ok: false, text: "There is no connection to the console." });
    this.buttons();
    return this.id;
  }

  setPrefix(prefix) {
    if (prefix === this.prefix) return;
    this.prefix = prefix;
    if (this.state.phase === "done") this.outcome(this.state);
  }

  reply({ id, ok, text }) {
    if (id !== this.id) return;
    this.busy = false;
    $("board-answer").dataset.ok = ok;
    // What went well the page shows by itself.
    set($("board-answer"), ok ? "" : text);
    this.buttons();
  }

  frame(frame) {
    return this.picture.frame(frame);
  }

  lost() {
    this.busy = false;
    this.told(NOTHING);
  }

  /** What the console says of the calibration. */
  told(state) {
    const before = this.state;
    this.state = state;
    const { phase, guidance, glance } = state;
    for (const part of document.querySelectorAll(".board-part")) part.hidden = !part.dataset.phase.split(" ").includes(phase);
    $("board-body").dataset.phase = phase;
    set($("board-what"), TITLES[phase] ?? phase);
    const other = state.by !== this.begun && phase !== "idle" ? ", begun on another page" : "";
    const time = phase === "running" ? `${state.seconds} s of ${state.limit_s}` : "";
    set($("board-phase"), `${time}${other}`.replace(/^, /, ""));
    this.picture.found(phase === "running", glance, guidance?.needs.find((need) => EDGES.includes(need.name))?.name);
    if (guidance) this.guide(guidance, glance);
    if (phase === "done" && (before.phase !== "done" || before.run !== state.run || before.saved !== state.saved)) this.outcome(state);
    this.sentence(before.phase !== phase || before.run !== state.run);
    this.shell();
    if (before.phase !== phase || before.run !== state.run || before.saved !== state.saved || before.guidance?.solved !== guidance?.solved) this.buttons();
  }

  guide(guidance, glance) {
    this.coverage.show(guidance, glance ? glance.size[0] / glance.size[1] : null);
    for (const gauge of guidance.gauges) {
      const shown = this.gauges.get(gauge.name) ?? this.gauge(gauge);
      set(shown.text, gauge.text);
      shown.bar.hidden = gauge.share === null;
      shown.bar.value = gauge.share ?? 0;
      shown.row.dataset.met = gauge.share === null || gauge.share >= 1;
    }
    for (const [name, { row }] of this.gauges) row.hidden = !guidance.gauges.some((gauge) => gauge.name === name);
    const key = JSON.stringify(guidance.needs);
    if (key === this.needs) return;
    this.needs = key;
    $("board-needs").replaceChildren(...guidance.needs.map(({ missing, advice }) => element("li", {}, [element("b", { textContent: missing }), advice])));
  }

  gauge({ name, label }) {
    const [text, bar] = [element("span", { className: "value" }), element("progress", { max: 1 })];
    bar.setAttribute("aria-label", label);
    const row = element("div", { className: "gauge" }, [icon(name), element("span", { textContent: label }), text, bar]);
    const shown = { row, text, bar };
    this.gauges.set(name, shown);
    $("gauges").append(row);
    return shown;
  }

  /** One sentence for somebody who looks from where the board is. */
  sentence(now) {
    const { phase, sentence, glance, guidance, outcome } = this.state;
    const time = performance.now();
    const taken = glance?.look === "taken" && guidance.views !== this.views;
    this.views = guidance?.views;
    const text = {
      idle: this.state.run === 0 && !this.state.limit_s ? "" : "Press Start when you have the board at hand", failed: capital(sentence), running: capital(sentence),
      done: outcome?.good ? `Calibrated from ${guidance.views} views` : `Calibrated from ${guidance?.views} views (${sentence}), but something is missing`,
    }[phase] ?? "";
    const show = (words, kind) => {
      $("board-says").dataset.kind = kind;
      set($("board-says"), words);
    };
    const kind = { idle: "", failed: "wrong", done: outcome?.good ? "good" : "wait" }[phase] ?? { taken: "good", known: "good", unfit: "wait" }[glance?.look] ?? "wrong";
    if (phase === "running" && taken) {
      this.held = time + TAKEN_MS;
      return show(`View ${guidance.views} is taken`, "good");
    }
    if (!now && phase === "running") {
      if (time < (this.held ?? 0)) return;
      if (text !== this.waits) [this.waits, this.since] = [text, time];
      if (time - this.since < SETTLED_MS) return;
    }
    show(text, kind);
  }

  outcome({ outcome, saved, camera }) {
    const digits = (unit) => (unit === "px" ? 2 : 5);
    $("board-values").tBodies[0].replaceChildren(...outcome.values.map(({ name, value, sigma, unit }) => {
      const d = digits(unit);
      return element("tr", {}, [
        element("th", { scope: "row", textContent: name }),
        element("td", { textContent: `${value.toFixed(d)}${unit && ` ${unit}`}` }),
        element("td", { textContent: sigma === null ? "not estimated" : `± ${sigma.toFixed(d)}${unit && ` ${unit}`}` }),
      ]);
    }));
    const words = outcome.words.map((text) => element("li", { textContent: capital(text).replace(" +- ", " ± ") }));
    const shell = (text) => element("code", { className: "shell", textContent: text });
    const of = this.prefix === "cairn" ? "" : ` --prefix ${quoted(this.prefix)}`;
    if (saved) {
      words.push(element("li", { className: "saved", textContent: `${capital(saved)}.` }));
      words.push(element("li", { className: "then" }, ["The present map goes on with the lens that it began with; Drop the map, under Live, begins the next one. On a terminal:", shell(`cairn command${of} reset`)]));
    } else if (camera) {
      words.push(element("li", {}, ["Save hands it to the daemon, for the next map. On a terminal, with the file of Download:", shell(`cairn command${of} keep-calibration ${outcome.file_name}`)]));
    }
    if (!camera) words.push(element("li", { textContent: "This daemon has no camera that it could be kept for (a recording or the simulator): Download has the file." }));
    $("board-words").replaceChildren(...words);
  }

  /** Those of the phase. */
  buttons() {
    const { phase, guidance, camera, saved } = this.state;
    const press = (action) => () => this.order(action);
    const all = {
      idle: [["Start", () => $("board-form").requestSubmit(), true]],
      failed: [["Start", () => $("board-form").requestSubmit(), true]],
      running: [
        ["Finish", press({ do: "finish" }), false, !guidance?.solved],
        ["Restart", () => this.again()],
        ["Cancel", press({ do: "cancel" })],
      ],
      done: [
        ...(camera && !saved ? [["Save", press({ do: "save" }), true]] : []),
        ["Download", () => download(this.state.outcome), !camera],
        ["New", press({ do: "cancel" })],
      ],
    }[phase] ?? [];
    const key = JSON.stringify([phase, this.busy, all.map(([text, , main, off]) => [text, main, off])]);
    if (key === this.shownButtons) return;
    this.shownButtons = key;
    const bar = $("board-buttons");
    // Whoever goes by keyboard stays here, though the button that was pressed is gone.
    this.focused = bar.contains(document.activeElement) || (this.focused && this.waited);
    this.waited = this.busy;
    bar.replaceChildren(...all.map(([textContent, onclick, main, off]) => element("button", { type: "button", textContent, onclick, className: main ? "main" : "", disabled: this.busy || off || false })));
    if (this.focused && !this.busy) bar.querySelector(phase === "running" ? "button:last-child" : "button:enabled")?.focus();
  }

  /** The same board from the beginning. */
  again() {
    const { board } = this.state;
    this.order({ do: "cancel" });
    this.begun = this.order({ do: "start", board });
  }

  /** What a terminal is told for the same. */
  shell() {
    const board = this.board();
    const size = `${board.columns}x${board.rows}`;
    const square = board.square_m ? ` --square ${board.square_m}` : "";
    set($("board-print"), `cairn calibrate --print-pattern ${size}${square} --output board.svg`);
    const lens = board.lens === "fisheye" ? " --distortion fisheye" : "";
    const open = this.state.phase === "idle" || this.state.phase === "failed";
    set($("board-shell"), open ? `cairn calibrate --camera auto --pattern ${size}${square}${lens}` : this.state.terminal);
  }
}

function capital(text) {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

function download({ file, file_name }) {
  const url = URL.createObjectURL(new Blob([file], { type: "application/toml" }));
  element("a", { href: url, download: file_name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}
