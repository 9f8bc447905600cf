// The daemon's log, filtered here.
const $ = (id) => document.getElementById(id);
const MOST = 600;
const RANK = { ERROR: 0, WARN: 1, INFO: 2, NOTE: 0, DEBUG: 3, TRACE: 3 };
/** What the console says of the log: where it comes from, why it cannot be read. */
const isNote = (record) => record.level === "NOTE";

export class Log {
  constructor() {
    this.records = [];
    for (const id of ["log-level", "log-filter"]) $(id).addEventListener("input", () => this.redraw());
    this.redraw();
  }

  add({ records, replace }) {
    if (replace) this.records = [];
    this.records.push(...records);
    this.records.splice(0, this.records.length - MOST);
    if (replace || this.isEmpty) return this.redraw();
    const list = $("records");
    list.append(...records.filter((r) => this.shows(r)).map(item));
    while (list.childElementCount > MOST) list.firstElementChild.remove();
    this.follow();
  }

  shows(record) {
    if ((RANK[record.level] ?? 2) > Number($("log-level").value)) return false;
    return $("log-filter").value.trim().split(/\s+/).filter(Boolean).every((word) => matches(record, word.toLowerCase()));
  }

  redraw() {
    const shown = this.records.filter((r) => this.shows(r));
    this.isEmpty = shown.every(isNote);
    // Whoever sees no record is told where they come from, whatever the filter.
    const items = (this.isEmpty ? this.records.filter(isNote) : shown).map(item);
    if (this.isEmpty) {
      const li = document.createElement("li");
      [li.className, li.textContent] = ["nothing", this.records.every(isNote) ? "No record so far." : "No record passes the filter."];
      items.push(li);
    }
    $("records").replaceChildren(...items);
    this.follow();
  }

  follow() {
    if ($("log-follow").checked) $("records").scrollTop = $("records").scrollHeight;
  }
}

/** `field=value`, or a word anywhere. */
function matches(record, word) {
  const [field, value] = word.split("=", 2);
  if (value !== undefined) return String(record.fields?.[field] ?? "").toLowerCase().includes(value);
  return JSON.stringify([record.message, record.fields]).toLowerCase().includes(word);
}

function item(record) {
  const li = document.createElement("li");
  li.dataset.level = record.level ?? "INFO";
  const time = document.createElement("time");
  const date = record.time ? new Date(record.time) : null;
  time.textContent = date && !Number.isNaN(date.valueOf()) ? date.toLocaleTimeString([], { hour12: false }) + `.${Math.floor(date.getMilliseconds() / 100)}` : "";
  const level = Object.assign(document.createElement("span"), { className: "level", textContent: record.level ?? "" });
  const text = document.createElement("span");
  text.textContent = record.message ?? "";
  const fields = Object.entries(record.fields ?? {}).map(([k, v]) => `${k}=${typeof v === "string" ? v : JSON.stringify(v)}`).join(" ");
  // With a space for whoever copies it, or hears it.
  if (fields) text.append(" ", Object.assign(document.createElement("span"), { className: "fields", textContent: fields }));
  li.append(time, level, text);
  return li;
}
