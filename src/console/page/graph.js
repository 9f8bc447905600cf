// What holds the map together: covisibility where it is asked for, closed loops and joined maps always, and what of them has just happened.
import { BufferAttribute, BufferGeometry, Color, DynamicDrawUsage, LineBasicMaterial, LineSegments, Points, ShaderMaterial } from "/vendor/three.js";
import { EDGE } from "/wire.js";
import { set } from "/state.js";

const $ = (id) => document.getElementById(id);
const NEWS = 4; // lines of what has happened
const FRESH_MS = 8000; // how long the newest stands out
const END_PX = 9;
const COLOURS = { covisible: ["#0b6b34", "#4fd483"], [EDGE.LOOP]: ["#7427d0", "#c79bff"], [EDGE.JOIN]: ["#b8126e", "#ff86c8"] };

// The ends of a loop or a join, so that a short one is seen.
const ENDS = {
  vertexShader: `
    attribute vec4 color;
    uniform float size;
    varying vec4 shade;
    void main() {
      shade = color;
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
      gl_PointSize = size;
    }`,
  fragmentShader: `
    varying vec4 shade;
    void main() {
      if (length(gl_PointCoord - 0.5) > 0.5) discard;
      gl_FragColor = shade;
      #include <colorspace_fragment>
    }`,
};

export class GraphView {
  /** map: the MapView that it is drawn in; changed(): what is asked for is another. */
  constructor(map, changed) {
    this.map = map;
    this.places = new Map();
    this.known = new Set();
    this.covisible = this.ties = null;
    $("draw-covisible").addEventListener("change", () => {
      this.covisible = null;
      this.show();
      changed();
    });
    if (!map.renderer) return;
    this.thin = this.lines(new LineBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false }));
    this.thick = this.lines(new LineBasicMaterial({ vertexColors: true }));
    this.ends = new Points(this.thick.geometry, new ShaderMaterial({ ...ENDS, uniforms: { size: { value: END_PX * Math.min(devicePixelRatio || 1, 2) } } }));
    this.ends.frustumCulled = this.ends.visible = false;
    map.scene.add(this.ends);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.show());
  }

  lines(material) {
    const lines = new LineSegments(new BufferGeometry(), material);
    lines.frustumCulled = lines.visible = false;
    this.map.scene.add(lines);
    return lines;
  }

  get isWanted() {
    return $("draw-covisible").checked;
  }

  /** Where each keyframe is, for lines between them. */
  keyframes({ keyframes, ids, count, epoch }) {
    this.places.clear();
    for (let k = 0; k < count; k++) this.places.set(ids[8 * k + 7], keyframes.subarray(8 * k, 8 * k + 3));
    this.epoch = epoch;
    this.show();
  }

  edges(message, isCovisible) {
    if (isCovisible) this.covisible = message;
    else {
      this.ties = message;
      this.tell(message);
    }
    this.show();
  }

  /** Another start of the daemon, whose keyframes are others; of the first one nothing is known to be new. */
  turnTo(run) {
    if (run === this.run) return;
    [this.run, this.told] = [run, false];
    this.known.clear();
    this.covisible = this.ties = null;
    $("map-news").replaceChildren();
    this.show();
  }

  /** Names what was not there before. */
  tell({ edges }) {
    const fresh = edges.filter(({ kind, from, to }) => !this.known.has(`${kind} ${from} ${to}`));
    fresh.forEach(({ kind, from, to }) => this.known.add(`${kind} ${from} ${to}`));
    // What happened before the page was opened is drawn, and no news.
    const isNews = this.told;
    this.told = true;
    const loops = fresh.filter((edge) => edge.kind === EDGE.LOOP);
    const more = loops.length > 1 ? `, and ${loops.length - 1} more` : "";
    if (loops.length > 0) this.say(`Loop closed: keyframe ${loops[0].to} shows the place of ${loops[0].from}${more}`, "loop", isNews);
    for (const { to, joined } of fresh.filter((edge) => edge.kind === EDGE.JOIN)) this.say(`Map ${joined} joined: keyframe ${to} shows a place of it`, "join", isNews);
  }

  say(text, kind, isNews) {
    const line = Object.assign(document.createElement("p"), { textContent: text, className: kind });
    if (isNews) {
      line.classList.add("fresh");
      setTimeout(() => line.classList.remove("fresh"), FRESH_MS);
    }
    $("map-news").append(line);
    while ($("map-news").childElementCount > NEWS) $("map-news").firstElementChild.remove();
  }

  /** Draws what is known of both ends in the same coordinates. */
  show() {
    const { canvas } = this.map;
    const dark = Number(matchMedia("(prefers-color-scheme: dark)").matches);
    const there = (message) => (message && message.epoch === this.epoch ? message.edges : []);
    const covisible = this.isWanted ? there(this.covisible) : [];
    const strongest = covisible[0]?.shared ?? 1;
    const colours = Object.fromEntries(Object.entries(COLOURS).map(([kind, pair]) => [kind, new Color(pair[dark])]));
    if (this.map.renderer) {
      // The more they see together the darker.
      canvas.dataset.covisible = this.fill(this.thin, covisible, ({ shared }) => [...colours.covisible, 0.12 + 0.6 * (shared / strongest)]);
      canvas.dataset.ties = this.fill(this.thick, there(this.ties), ({ kind }) => [...(colours[kind] ?? colours.covisible), 1]);
      this.map.draw();
    }
    const note = this.isWanted ? (covisible.length > 0 ? `${covisible.length} pairs see the same landmarks` : "no covisibility yet") : "";
    set($("covisible-count"), note);
  }

  /** Lines between the keyframes that are there; how many. */
  fill(lines, edges, colour) {
    const { geometry } = lines;
    const room = geometry.attributes.position?.count ?? 0;
    if (2 * edges.length > room) {
      geometry.dispose();
      for (const [name, size] of [["position", 3], ["color", 4]]) geometry.setAttribute(name, new BufferAttribute(new Float32Array(4 * edges.length * size), size).setUsage(DynamicDrawUsage));
    }
    const { position, color } = geometry.attributes;
    let n = 0;
    for (const edge of edges) {
      const [from, to] = [this.places.get(edge.from), this.places.get(edge.to)];
      if (!from || !to) continue;
      const shade = colour(edge);
      [from, to].forEach((place, end) => {
        position.array.set(place, 3 * (2 * n + end));
        color.array.set(shade, 4 * (2 * n + end));
      });
      n += 1;
    }
    if (position) [position.needsUpdate, color.needsUpdate] = [true, true];
    geometry.setDrawRange(0, 2 * n);
    lines.visible = n > 0;
    if (lines === this.thick) this.ends.visible = n > 0;
    return n;
  }
}
