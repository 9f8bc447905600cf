// Exposure, gain and focus: what the camera offers is asked for, and each can be set or left to the camera.
import { quoted } from "/controls.js";

const $ = (id) => document.getElementById(id);
const FIRST_ID = 2_000_000; // apart from the commands' and the chain's

/** A line of the daemon's answer: NAME UNIT LOWEST HIGHEST STEP DEFAULT VALUE WHO. */
function parse(line) {
  const [name, unit, ...rest] = line.split(" ");
  const [low, high, step, initial, value] = rest.slice(0, 5).map(Number);
  return { name, unit, low, high, step, initial, value, who: rest[5] };
}

const element = (tag, fields) => Object.assign(document.createElement(tag), fields);

export class CameraView {
  constructor(say) {
    this.say = say;
    this.prefix = "cairn";
    this.id = FIRST_ID;
    this.waiting = new Map();
    this.rows = new Map();
    this.first = this.row("What it offers", () => "", () => this.ask(this.first));
    $("camera").append(this.first.element);
  }

  /** A button with its command below; `fields` beside it. */
  row(name, shell, press, fields = []) {
    const form = element("form", { className: "command" });
    const button = element("button", { type: "submit", textContent: name });
    const beside = element("div", { className: "fields" });
    beside.append(...fields);
    const code = element("code", { className: "shell" });
    const output = element("output", {});
    form.append(button, beside, code, output);
    const row = { element: form, button, output };
    row.show = () => { code.textContent = `cairn command ${this.prefix === "cairn" ? "" : `--prefix ${quoted(this.prefix)} `}camera${shell()}`; };
    form.addEventListener("input", row.show);
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      press();
    });
    row.show();
    return row;
  }

  ask(row) {
    this.send(row, { do: "camera_controls" }, (ok, text) => {
      if (row) this.answer(row, ok, ok ? "" : text);
      this.controls(ok ? text.split("\n").filter(Boolean).map(parse) : []);
    });
  }

  send(row, action, done) {
    this.id += 1;
    this.waiting.set(this.id, { row, done });
    if (row) {
      row.button.disabled = true;
      this.answer(row, null, "asked …");
    }
    if (!this.say({ command: { id: this.id, action } })) this.reply({ id: this.id, ok: false, text: "There is no connection to the console." });
  }

  reply({ id, ok, text }) {
    const asked = this.waiting.get(id);
    if (!asked) return;
    this.waiting.delete(id);
    if (asked.row) asked.row.button.disabled = false;
    asked.done(ok, text);
  }

  answer(row, ok, text) {
    row.output.textContent = text;
    row.output.dataset.ok = ok ?? "";
  }

  /** A row for each control there is, its field as the camera has it. */
  controls(found) {
    for (const [name, { row }] of this.rows) {
      if (found.some((control) => control.name === name)) continue;
      row.element.remove();
      this.rows.delete(name);
    }
    for (const control of found) {
      if (!this.rows.has(control.name)) this.rows.set(control.name, this.controlRow(control));
      const { row, number, automatic, label } = this.rows.get(control.name);
      // Of another camera, in the place of the one before, they are others.
      const { low, high, step, unit } = control;
      Object.assign(number, { min: low, max: high, step, title: `${low} to ${high} ${unit}` });
      label.hidden = control.who === "manual-only";
      if (Number.isFinite(control.value)) number.value = control.value;
      automatic.checked = control.who === "auto";
      number.disabled = automatic.checked;
      row.show();
    }
  }

  controlRow({ name, unit }) {
    const number = element("input", { type: "number", required: true });
    number.setAttribute("aria-label", `${name}, ${unit}`);
    const automatic = element("input", { type: "checkbox" });
    const label = element("label", { className: "auto" });
    label.append(automatic, "auto");
    automatic.addEventListener("change", () => { number.disabled = automatic.checked; });
    const to = () => (automatic.checked ? null : Number(number.value));
    const row = this.row(`Set ${name}`, () => ` ${name} ${to() ?? "auto"}`, () => {
      this.send(row, { do: "set_camera", control: name, value: to() }, (ok, text) => {
        this.answer(row, ok, text);
        // The camera takes a value to its nearest step, and may have changed others with it.
        if (ok) this.ask(null);
      });
    }, [number, element("span", { className: "quiet", textContent: unit }), label]);
    $("camera").append(row.element);
    return { row, number, automatic, label };
  }

  /** Answers of a connection that has gone do not come any more. */
  lost() {
    for (const id of [...this.waiting.keys()]) this.reply({ id, ok: false, text: "The connection was lost: it may have been carried out." });
  }

  /** Another daemon's camera is another one. */
  turnTo(run) {
    if (run === this.run) return;
    this.run = run;
    this.controls([]);
    this.answer(this.first, null, "");
  }

  setPrefix(prefix) {
    if (prefix === this.prefix) return;
    this.prefix = prefix;
    [this.first, ...[...this.rows.values()].map(({ row }) => row)].forEach((row) => row.show());
  }
}
