// State, numbers and faults in words.
const $ = (id) => document.getElementById(id);
const known = (v) => v !== null && v !== undefined && Number.isFinite(v);
const number = (v, digits = 0, unit = "") => (known(v) ? `${v.toFixed(digits)}${unit}` : "–");
const percent = (v) => (known(v) ? number(100 * v, 0, " %") : "–");
/** Of a scale: a tenth of a per cent counts. */
const fine = (v) => (known(v) ? number(100 * v, v < 0.0995 ? 1 : 0, " %") : "–");
const SOURCES = { WHEELS: "wheels", HEIGHT: "height", TAG: "tags", STORED_MAP: "stored map" };
const sources = (d) => d.scale_source.map((name) => SOURCES[name] ?? name.toLowerCase()).join(", ") || "–";
const WORDS = { INITIALIZING: "initializing", TRACKING: "tracking", LOST: "lost", ORIENTATION: "heading only", DEAD_RECKONING: "dead reckoning" };

const NUMBERS = [
  ["Pictures", (d) => number(d.rate_hz, 1, " /s")],
  ["Latency p50", (d) => number(d.latency_p50_ms, 1, " ms")],
  ["Latency p95", (d) => number(d.latency_p95_ms, 1, " ms")],
  ["Latency p99", (d) => number(d.latency_p99_ms, 1, " ms")],
  ["Quality", (d, s) => (s?.state === "TRACKING" ? number(s.quality, 2) : "–")],
  ["Landmarks found", (d, s) => (s ? `${s.landmarks} of ${s.sought}` : "–")],
  ["Frames dropped", (d) => `${d.frames_dropped}`],
  ["Frames corrupt", (d) => `${d.frames_corrupt}`],
  ["Keyframes", (d) => `${d.keyframes}`],
  ["Landmarks", (d) => `${d.landmarks}`],
  ["Maps kept, joined", (d) => `${d.maps}, ${d.maps_joined}`],
  ["Resets", (d) => `${d.resets}`],
  ["Found again", (d) => `${d.relocalisations}`],
  ["Loops closed", (d) => `${d.loops_closed}`],
  ["Scale", (d) => ({ UNKNOWN: "map units", ESTIMATED: `estimated ± ${percent(d.scale_sigma)}`, METRIC: `metres ± ${fine(d.scale_sigma)}` })[d.scale]],
  ["Scale from", (d) => sources(d)],
  ["Lens", (d) => (d.intrinsics === "CALIBRATED" ? "calibrated" : `${d.intrinsics.toLowerCase()} ± ${percent(d.focal_sigma)}`)],
  ["Focal length", (d) => number(d.focal_px[0], 0, " px")],
  ["Position", (d, s) => (s?.state === "TRACKING" ? s.position.map((v) => v.toFixed(2)).join(" ") : "–")],
  ["Up for", (d) => duration(d.uptime_s)],
];

function duration(s) {
  const [h, m] = [Math.floor(s / 3600), Math.floor(s / 60) % 60];
  return h > 0 ? `${h} h ${m} min` : m > 0 ? `${m} min ${Math.floor(s % 60)} s` : `${Math.floor(s)} s`;
}

export class StateView {
  constructor() {
    this.values = NUMBERS.map(([name]) => {
      const dt = document.createElement("dt");
      const dd = document.createElement("dd");
      const pair = document.createElement("div");
      [dt.textContent, dd.textContent] = [name, "–"];
      pair.append(dt, dd);
      $("numbers").append(pair);
      return dd;
    });
  }

  sample(sample) {
    this.last = sample;
  }

  /** What the console says of the daemon. */
  report(report) {
    const { daemon, link } = report;
    const live = link === "connected" && daemon;
    const state = live ? daemon.state : "NONE";
    set($("prefix"), `${report.prefix}${daemon ? ` · ${daemon.version}` : ""}`);
    const words = { waiting: "no daemon", silent: "silent", error: "cannot be read" };
    set($("state"), live ? WORDS[state] ?? state : words[link] ?? "connecting");
    $("state").dataset.state = state;
    set($("sentence"), report.sentence);
    // Without a camera no pose comes, and the last one is none of now.
    const now = state === "TRACKING" ? this.last : undefined;
    NUMBERS.forEach(([, value], i) => set(this.values[i], live ? value(daemon, now) : "–"));
    this.faults(live ? daemon.faults : null);
    return live ? "" : report.sentence;
  }

  /** The console is gone: nothing is known. */
  away() {
    this.values.forEach((value) => set(value, "–"));
    set($("sentence"), "");
    this.faults(null);
  }

  /** `null`: they are not known. */
  faults(faults) {
    const key = JSON.stringify(faults);
    if (key === this.shownFaults) return;
    this.shownFaults = key;
    const items = (faults ?? []).map(({ name, advice }) => {
      const li = document.createElement("li");
      const b = document.createElement("b");
      b.textContent = name;
      li.append(b, advice);
      return li;
    });
    if (items.length === 0) {
      const li = document.createElement("li");
      [li.className, li.textContent] = faults ? ["none", "No fault stands."] : ["none unknown", "Not known."];
      items.push(li);
    }
    $("faults").replaceChildren(...items);
  }
}

/** Screen readers speak what changes, so nothing is written twice. */
export function set(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
