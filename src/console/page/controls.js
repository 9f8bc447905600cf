// Buttons: each is a command of the terminal, and shows it.
const ASK_MS = 4000; // how long a button that drops something waits for its second click

const COMMANDS = [
  { name: "Drop the map", danger: true, action: () => ({ do: "reset" }), shell: () => "reset" },
  { name: "Save the map", fields: [{ name: "File of the daemon's machine", value: "/var/lib/cairn/map.ply" }], action: ([path]) => ({ do: "save_map", path }), shell: ([path]) => `save-map ${quoted(path)}` },
  { name: "Save the trajectory", fields: [{ name: "File of the daemon's machine", value: "/var/lib/cairn/trajectory.txt" }], action: ([path]) => ({ do: "save_trajectory", path }), shell: ([path]) => `save-trajectory ${quoted(path)}` },
  { name: "Keep the map", fields: [{ name: "Name for a copy, or empty: its own file", value: "", optional: true, map: true }], action: ([name]) => ({ do: "store_map", name }), shell: ([name]) => (name ? `save ${quoted(name)}` : "save"), of: "map" },
  { name: "Go on in a map", fields: [{ name: "Name of a map; the list is the daemon's", value: "", map: true, list: true }], action: ([name]) => ({ do: "load_map", name }), shell: ([name]) => `load ${quoted(name || "NAME")}`, of: "map" },
  { name: "Begin a new map", fields: [{ name: "Its name", value: "", map: true }], action: ([name]) => ({ do: "new_map", name }), shell: ([name]) => `new ${quoted(name || "NAME")}`, of: "map" },
  { name: "Only locate in the map", action: () => ({ do: "localise_only", on: true }), shell: () => "localise on", of: "map" },
  { name: "Let the map grow again", action: () => ({ do: "localise_only", on: false }), shell: () => "localise off", of: "map" },
  {
    name: "The robot is at", fields: [["x", "x"], ["y", "y"], ["yaw, degrees", "yaw °"]].map(([name, shown]) => ({ name, shown, value: "0", number: true })),
    action: ([x, y, yaw]) => ({ do: "set_pose", x: Number(x), y: Number(y), yaw_deg: Number(yaw) }),
    shell: (values) => `set-pose ${values.map((v) => Number(v)).join(" ")}`,
  },
];

export function quoted(word) {
  return /^[\w/.+:@-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`;
}

export class Controls {
  constructor(say) {
    this.say = say;
    this.prefix = "cairn";
    this.id = 0;
    this.waiting = new Map();
    this.lists = new Map();
    this.rows = COMMANDS.map((command) => this.row(command));
    document.getElementById("commands").append(...this.rows.map((row) => row.element));
  }

  row(command) {
    const element = document.createElement("form");
    element.className = "command";
    const button = Object.assign(document.createElement("button"), { type: "submit", textContent: command.name });
    const fields = Object.assign(document.createElement("div"), { className: "fields" });
    const inputs = (command.fields ?? []).map(({ name, shown, value, number, map, optional, list }) => {
      const input = Object.assign(document.createElement("input"), { value, required: !optional, title: name, spellcheck: false });
      if (map) [input.pattern, input.maxLength, input.placeholder] = ["[A-Za-z0-9][A-Za-z0-9._\\-]*", 64, optional ? "its own file" : "name"];
      else if (number) [input.inputMode, input.pattern] = ["decimal", "-?[0-9]+([.][0-9]+)?"];
      else [input.pattern, input.maxLength] = ["/.+", 500];
      input.setAttribute("aria-label", `${command.name}: ${name}`);
      if (list) fields.append(this.listed(input));
      if (shown) fields.append(Object.assign(document.createElement("span"), { textContent: shown, ariaHidden: "true" }));
      fields.append(input);
      return input;
    });
    const shell = Object.assign(document.createElement("code"), { className: "shell" });
    const output = document.createElement("output");
    element.append(button, fields, shell, output);
    const row = { element, button, output, command, values: () => inputs.map((input) => input.value) };
    row.show = () => { shell.textContent = `cairn ${command.of ?? "command"}${this.prefix === "cairn" ? "" : ` --prefix ${quoted(this.prefix)}`} ${command.shell(row.values())}`; };
    element.addEventListener("input", row.show);
    element.addEventListener("submit", (event) => {
      event.preventDefault();
      this.press(row);
    });
    row.show();
    return row;
  }

  /** Names to choose from, asked of the daemon whenever the field is entered. */
  listed(input) {
    const names = Object.assign(document.createElement("datalist"), { id: "stored-maps" });
    input.setAttribute("list", names.id);
    input.addEventListener("focus", () => {
      this.id += 1;
      this.lists.set(this.id, names);
      this.say({ command: { id: this.id, action: { do: "list_maps" } } });
    });
    return names;
  }

  press(row) {
    if (row.command.danger && !row.armed) {
      row.armed = setTimeout(() => this.disarm(row), ASK_MS);
      row.button.classList.add("danger");
      row.button.textContent = "Really drop it?";
      return;
    }
    this.disarm(row);
    this.id += 1;
    this.waiting.set(this.id, row);
    row.button.disabled = true;
    this.answer(row, null, "asked …");
    const said = this.say({ command: { id: this.id, action: row.command.action(row.values()) } });
    if (!said) this.reply({ id: this.id, ok: false, text: "There is no connection to the console." });
  }

  disarm(row) {
    clearTimeout(row.armed);
    row.armed = null;
    row.button.classList.remove("danger");
    row.button.textContent = row.command.name;
  }

  reply({ id, ok, text }) {
    const names = this.lists.get(id);
    if (names) {
      this.lists.delete(id);
      const maps = ok && text !== "no maps yet" ? text.split("\n") : [];
      names.replaceChildren(...maps.map((line) => Object.assign(document.createElement("option"), { value: line.split(" ")[0], label: line })));
      return;
    }
    const row = this.waiting.get(id);
    if (!row) return;
    this.waiting.delete(id);
    row.button.disabled = false;
    this.answer(row, ok, text);
  }

  answer(row, ok, text) {
    row.output.textContent = text;
    row.output.dataset.ok = ok ?? "";
  }

  /** Answers of a connection that has gone do not come any more. */
  lost() {
    this.lists.clear();
    for (const id of [...this.waiting.keys()]) this.reply({ id, ok: false, text: "The connection was lost: it may have been carried out." });
  }

  setPrefix(prefix) {
    if (prefix === this.prefix) return;
    this.prefix = prefix;
    this.rows.forEach((row) => row.show());
  }
}
