// The map: landmarks in one draw call, the robot's way, keyframes and the robot itself.
import {
  BufferAttribute, BufferGeometry, Color, DynamicDrawUsage, GridHelper, InterleavedBuffer, InterleavedBufferAttribute, Line, LineBasicMaterial,
  LineSegments, OrbitControls, PerspectiveCamera, Points, Quaternion, Scene, ShaderMaterial, Vector3, WebGLRenderer,
} from "/vendor/three.js";
import { set } from "/state.js";

const $ = (id) => document.getElementById(id);
const MOST_WAY = 20000, MOST_KEYFRAMES = 2000, FIRST_POINTS = 20000;
const MOST_SLOW = 50000; // landmarks that software draws some twenty times a second on two cores; it takes three quarters of a microsecond each
const SAMPLED = 3000; // landmarks that the extent is judged by
// A corrected map is found in the one before by the keyframes of both: so many next to what is looked at, which must agree to a tenth of their spread.
const CARRIERS = 12, AGREE = 0.1;
const BARS = [1, 2, 5];
// A pyramid that looks along x, as REP-103 has it: tip, and four corners.
const CORNERS = [[0, 0, 0], [1, 0.6, 0.45], [1, -0.6, 0.45], [1, -0.6, -0.45], [1, 0.6, -0.45]];
const EDGES = [0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1];

const POINTS = {
  vertexShader: `
    uniform float low, high, size;
    varying float height;
    void main() {
      height = clamp((position.z - low) / max(high - low, 1e-6), 0.0, 1.0);
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
      gl_PointSize = size;
    }`,
  fragmentShader: `
    uniform vec3 below, above;
    varying float height;
    void main() {
      if (length(gl_PointCoord - 0.5) > 0.5) discard;
      gl_FragColor = vec4(mix(below, above, height), 1.0);
    }`,
};

/** Without a graphics card smooth edges cost two thirds of the pictures a second. */
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const names = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = gl?.getParameter(names?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER) ?? "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

export class MapView {
  constructor() {
    this.canvas = $("map");
    this.view = "orbit";
    this.way = [];
    this.drawn = 0; // of the way, in the line
    this.places = new Map(); // keyframe -> x, y, z of the message before
    this.sorted = [0, 1, 2].map(() => new Float32Array(SAMPLED + 1));
    this.center = new Vector3();
    this.radius = 1;
    try {
      this.isSlow = isSoftware();
      this.renderer = new WebGLRenderer({ canvas: this.canvas, antialias: !this.isSlow });
    } catch {
      set($("map-empty"), "This browser draws no WebGL, so there is no map here.");
      return;
    }
    this.camera = new PerspectiveCamera(50, 4 / 3, 0.01, 1000);
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(-2, -2, 2);
    this.scene = new Scene();
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.addEventListener("change", () => this.draw());
    this.controls.addEventListener("start", () => { this.taken = true; });
    this.controls.listenToKeyEvents(this.canvas);
    this.build();
    this.colours();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.colours());
    new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
    for (const button of document.querySelectorAll("[data-view]")) button.addEventListener("click", () => this.choose(button.dataset.view));
    this.canvas.addEventListener("webglcontextrestored", () => this.draw());
  }

  build() {
    const uniforms = { low: { value: 0 }, high: { value: 1 }, size: { value: 2 }, below: { value: new Color() }, above: { value: new Color() } };
    this.points = new Points(new BufferGeometry(), new ShaderMaterial({ ...POINTS, uniforms }));
    this.line = new Line(new BufferGeometry(), new LineBasicMaterial());
    this.frusta = new LineSegments(new BufferGeometry(), new LineBasicMaterial({ transparent: true, opacity: 0.55 }));
    this.robot = new LineSegments(new BufferGeometry(), new LineBasicMaterial());
    this.grid = new GridHelper(1, 10);
    this.grid.rotation.x = Math.PI / 2;
    const room = (object, length, size = 3) => {
      const attribute = new BufferAttribute(new Float32Array(length * size), size).setUsage(DynamicDrawUsage);
      object.geometry.setAttribute("position", attribute);
      object.geometry.setDrawRange(0, 0);
      object.frustumCulled = false;
    };
    room(this.line, MOST_WAY);
    room(this.frusta, MOST_KEYFRAMES * EDGES.length);
    room(this.robot, EDGES.length);
    this.room(FIRST_POINTS);
    this.robot.geometry.attributes.position.array.set(EDGES.flatMap((corner) => CORNERS[corner]));
    this.robot.geometry.setDrawRange(0, EDGES.length);
    this.robot.visible = this.grid.visible = false;
    this.points.frustumCulled = false;
    this.scene.add(this.grid, this.points, this.frusta, this.line, this.robot);
  }

  /** Memory for so many landmarks, x, y, z, sigma each, as they come. */
  room(count) {
    this.points.geometry.dispose();
    this.buffer = new InterleavedBuffer(new Float32Array(4 * count), 4).setUsage(DynamicDrawUsage);
    this.points.geometry = new BufferGeometry();
    this.points.geometry.setAttribute("position", new InterleavedBufferAttribute(this.buffer, 3, 0));
    this.points.geometry.setDrawRange(0, 0);
  }

  colours() {
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    const red = dark ? "#ff6a62" : "#cf2018";
    this.scene.background = new Color(getComputedStyle(this.canvas).getPropertyValue("--stage").trim() || "#dfe5ec");
    const { below, above } = this.points.material.uniforms;
    // As they are to be seen: the shader writes them without a conversion.
    below.value.set(dark ? "#2450c0" : "#082a78").convertLinearToSRGB();
    above.value.set(dark ? "#8cbcff" : "#4c9bff").convertLinearToSRGB();
    this.line.material.color.set(red);
    this.frusta.material.color.set(red);
    this.robot.material.color.set(dark ? "#ffb020" : "#e07b00");
    this.grid.material.vertexColors = false;
    this.grid.material.color.set(dark ? "#1f2a36" : "#c6cfda");
    this.grid.material.needsUpdate = true;
    this.draw();
  }

  landmarks({ points, count, total, scale, epoch }) {
    if (!this.renderer) return;
    const began = performance.now();
    const every = this.isSlow ? Math.max(1, Math.ceil(count / MOST_SLOW)) : 1;
    const drawn = Math.ceil(count / every);
    if (4 * drawn > this.buffer.array.length) this.room(2 * drawn);
    this.place(epoch);
    const { array } = this.buffer;
    if (every === 1) array.set(points);
    else for (let i = 0; i < drawn; i++) for (let a = 0; a < 3; a++) array[4 * i + a] = points[4 * i * every + a];
    this.buffer.clearUpdateRanges();
    this.buffer.addUpdateRange(0, 4 * drawn);
    this.buffer.needsUpdate = true;
    this.points.geometry.setDrawRange(0, drawn);
    this.metric = scale === 2;
    this.count = count;
    this.measure(points, count);
    if (this.told && !(Math.abs(this.radius / this.sized - 1) < 0.15)) this.drawFrusta();
    const left = (total > count ? `, the newest of ${total}` : "") + (every > 1 ? `, one of ${every} drawn: no graphics card` : "");
    set($("map-size"), count > 0 ? `${count} landmarks${left}` : "");
    $("map-empty").hidden = count > 0;
    // The view grows with the map until somebody takes hold of it.
    if (count > 0 && !this.taken && this.view !== "follow" && !(this.radius < 1.15 * this.fitted)) this.fit();
    this.draw();
    this.canvas.dataset.landmarks = count;
    this.canvas.dataset.updateMs = (performance.now() - began).toFixed(2);
  }

  /** Middle, size and heights of the bulk: a few landmarks are always far away. */
  measure(points, count) {
    if (count === 0) return;
    const step = Math.max(1, Math.ceil(count / SAMPLED));
    const sampled = Math.ceil(count / step);
    const axes = this.sorted.map((values, a) => {
      for (let n = 0; n < sampled; n++) values[n] = points[4 * n * step + a];
      return values.subarray(0, sampled).sort();
    });
    const at = (a, share) => axes[a][Math.floor(share * (sampled - 1))];
    const ends = [0, 1, 2].map((a) => [at(a, 0.05), at(a, 0.95)]);
    // The way belongs to it, wherever it leads.
    const { array } = this.line.geometry.attributes.position;
    for (let i = 0; i < 3 * this.drawn; i++) {
      const end = ends[i % 3];
      if (array[i] < end[0]) end[0] = array[i];
      else if (array[i] > end[1]) end[1] = array[i];
    }
    this.center.set(...ends.map(([from, to]) => (from + to) / 2));
    this.radius = Math.max(1e-3, Math.hypot(...ends.map(([from, to]) => (to - from) / 2)));
    const { low, high } = this.points.material.uniforms;
    [low.value, high.value] = [at(2, 0.05), at(2, 0.95)];
    const cell = 10 ** Math.ceil(Math.log10(this.radius / 4));
    this.grid.scale.setScalar(10 * cell);
    this.grid.position.set(Math.round(this.center.x / cell) * cell, Math.round(this.center.y / cell) * cell, low.value);
    this.grid.visible = true;
    this.robot.scale.setScalar(this.radius * 0.07);
  }

  keyframes({ keyframes, count, epoch }) {
    if (!this.renderer) return;
    this.place(epoch, keyframes, count);
    this.told = { keyframes, count };
    this.drawFrusta();
  }

  /** As large as the map wants them. */
  drawFrusta() {
    const { keyframes, count } = this.told;
    const shown = Math.min(count, MOST_KEYFRAMES);
    this.sized = this.radius;
    const { array } = this.frusta.geometry.attributes.position;
    const [turn, corner] = [new Quaternion(), new Vector3()];
    const corners = new Float32Array(3 * CORNERS.length);
    const size = this.radius * 0.035;
    let out = 0;
    for (let k = count - shown; k < count; k++) {
      const at = 8 * k;
      turn.set(keyframes[at + 3], keyframes[at + 4], keyframes[at + 5], keyframes[at + 6]);
      for (let c = 0; c < CORNERS.length; c++) {
        corner.fromArray(CORNERS[c]).multiplyScalar(size).applyQuaternion(turn).toArray(corners, 3 * c);
        for (let a = 0; a < 3; a++) corners[3 * c + a] += keyframes[at + a];
      }
      for (const edge of EDGES) for (let a = 0; a < 3; a++) array[out++] = corners[3 * edge + a];
    }
    const { position } = this.frusta.geometry.attributes;
    position.clearUpdateRanges();
    position.addUpdateRange(0, out);
    position.needsUpdate = true;
    this.frusta.geometry.setDrawRange(0, shown * EDGES.length);
    this.draw();
  }

  /** Positions of another epoch are out of place. Those of a map that was corrected, or has got its metres, are elsewhere than before: the eye goes along. */
  place(epoch, keyframes, count = 0) {
    this.turnTo(epoch);
    if (this.placed !== epoch) {
      const isKnown = this.placed === undefined || this.carry(keyframes, count);
      if (!isKnown) [this.taken, this.fitted] = [false, undefined];
      this.placed = epoch;
    }
    if (!keyframes) return;
    this.places.clear();
    const ids = new Uint32Array(keyframes.buffer, keyframes.byteOffset, keyframes.length);
    for (let k = 0; k < count; k++) this.places.set(ids[8 * k + 7], keyframes.subarray(8 * k, 8 * k + 7));
  }

  /** Moves the eye as the keyframes next to what it looks at were moved; false where these are none of the map before. */
  carry(keyframes, count) {
    const ids = keyframes && new Uint32Array(keyframes.buffer, keyframes.byteOffset, keyframes.length);
    const { target } = this.controls;
    const vector = (values) => new Vector3(values[0], values[1], values[2]);
    const pairs = [];
    for (let k = 0; k < count; k++) {
      const before = this.places.get(ids[8 * k + 7]);
      if (before) pairs.push({ before, now: keyframes.subarray(8 * k, 8 * k + 7), away: vector(before).distanceToSquared(target) });
    }
    if (pairs.length < 3) return false;
    pairs.sort((a, b) => a.away - b.away).splice(CARRIERS);
    const middle = (which) => pairs.reduce((sum, pair) => sum.add(vector(pair[which])), new Vector3()).divideScalar(pairs.length);
    const [from, to] = [middle("before"), middle("now")];
    const spread = (which, centre) => Math.sqrt(pairs.reduce((sum, pair) => sum + vector(pair[which]).distanceToSquared(centre), 0));
    const [wide, wideNow] = [spread("before", from), spread("now", to)];
    const scale = wideNow / wide;
    const quaternion = ([, , , x, y, z, w]) => new Quaternion(x, y, z, w);
    const turn = quaternion(pairs[0].now).multiply(quaternion(pairs[0].before).invert());
    const moved = (place) => place.sub(from).multiplyScalar(scale).applyQuaternion(turn).add(to);
    const off = Math.sqrt(pairs.reduce((sum, { before, now }) => sum + moved(vector(before)).distanceToSquared(vector(now)), 0));
    // Written so that NaN is none.
    if (!(off <= AGREE * wideNow)) return false;
    moved(target);
    moved(this.camera.position);
    [this.radius, this.fitted] = [this.radius * scale, this.fitted && this.fitted * scale];
    [this.camera.near, this.camera.far] = [this.camera.near * scale, this.camera.far * scale];
    this.camera.updateProjectionMatrix();
    this.controls.update();
    return true;
  }

  turnTo(epoch) {
    if (this.epoch === epoch) return;
    this.epoch = epoch;
    this.drawWay();
  }

  history(samples) {
    this.way = samples.filter((s) => s.state === "TRACKING").slice(-MOST_WAY);
    if (samples.length > 0) this.turnTo(samples.at(-1).epoch);
    if (this.renderer) this.drawWay();
  }

  pose(sample) {
    if (!this.renderer) return;
    const tracking = sample.state === "TRACKING";
    this.robot.visible = tracking && this.count > 0;
    if (tracking) {
      this.way.push(sample);
      const isFull = this.way.length > MOST_WAY;
      if (isFull) this.way.splice(0, 1000);
      this.robot.position.set(...sample.position);
      this.robot.quaternion.set(...sample.orientation);
      if (sample.epoch !== this.epoch) this.turnTo(sample.epoch);
      else if (isFull) this.drawWay();
      else this.goOn(sample);
      if (this.view === "follow") this.follow();
    }
    this.draw();
  }

  drawWay() {
    if (!this.renderer) return;
    const { position } = this.line.geometry.attributes;
    this.drawn = 0;
    for (const s of this.way) if (s.epoch === this.epoch) position.array.set(s.position, 3 * this.drawn++);
    position.clearUpdateRanges();
    position.addUpdateRange(0, 3 * this.drawn);
    position.needsUpdate = true;
    this.line.geometry.setDrawRange(0, this.drawn);
  }

  /** Adds a place to the line that is drawn already. */
  goOn({ position: [x, y, z] }) {
    const { position } = this.line.geometry.attributes;
    position.setXYZ(this.drawn, x, y, z);
    // One range, however long nobody draws it.
    const last = position.updateRanges.at(-1);
    if (last && last.start + last.count === 3 * this.drawn) last.count += 3;
    else position.addUpdateRange(3 * this.drawn, 3);
    position.needsUpdate = true;
    this.drawn += 1;
    this.line.geometry.setDrawRange(0, this.drawn);
  }

  choose(view) {
    this.taken = false;
    if (view === "fit") return this.fit();
    this.view = view;
    for (const button of document.querySelectorAll("[data-view][aria-pressed]")) button.setAttribute("aria-pressed", `${button.dataset.view === view}`);
    this.controls.enableRotate = view !== "top";
    if (view === "follow") this.follow();
    else this.fit();
  }

  fit() {
    if (!this.renderer || !(this.count > 0)) return;
    this.fitted = this.radius;
    const away = (1.15 * this.radius) / Math.tan((Math.PI / 180) * (this.camera.fov / 2));
    const from = this.view === "top" ? new Vector3(-1e-3, 0, 1) : new Vector3(-0.75, -0.75, 0.62);
    this.controls.target.copy(this.center);
    this.camera.position.copy(this.center).addScaledVector(from.normalize(), away);
    [this.camera.near, this.camera.far] = [this.radius / 200, this.radius * 60];
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.draw();
  }

  /** Behind the robot and above it. */
  follow() {
    const back = new Vector3(-0.55, 0, 0.3).multiplyScalar(this.radius).applyQuaternion(this.robot.quaternion);
    this.camera.position.lerp(back.add(this.robot.position), 0.15);
    this.controls.target.lerp(this.robot.position, 0.3);
    this.controls.update();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (width === 0) return;
    const ratio = this.isSlow ? 1 : Math.min(devicePixelRatio || 1, 2);
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
    this.points.material.uniforms.size.value = 2.6 * ratio;
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    this.draw();
  }

  setAway(away, state) {
    this.canvas.parentElement.classList.toggle("stale", away);
    if (!this.renderer) return;
    if (away || state !== "TRACKING") this.robot.visible = false;
    if (!(this.count > 0)) {
      set($("map-empty"), away ? "No map: there is no daemon to hear." : state === "LOST" ? "Lost." : "No map yet: move the camera sideways.");
    }
  }

  /** Once a picture of the screen, and only what has changed. */
  draw() {
    if (this.asked || !this.renderer) return;
    this.asked = requestAnimationFrame(() => {
      this.asked = null;
      this.renderer.render(this.scene, this.camera);
      this.drawScale();
      this.afterDrawing?.();
    });
  }

  /** A bar of a round length at the distance that is looked at. */
  drawScale() {
    const height = 2 * this.camera.position.distanceTo(this.controls.target) * Math.tan((Math.PI / 360) * this.camera.fov);
    const perPixel = height / Math.max(1, this.canvas.clientHeight);
    const power = 10 ** Math.floor(Math.log10(120 * perPixel));
    const length = BARS.map((b) => b * power).findLast((l) => l <= 120 * perPixel) ?? power;
    $("scale").hidden = !(this.count > 0);
    set($("scale").firstElementChild, `${Number(length.toPrecision(1))} ${this.metric ? "m" : "map units"}`);
    $("scale").lastElementChild.style.width = `${length / perPixel}px`;
  }
}
