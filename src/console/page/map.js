// The map: landmarks in one draw call, the robot's way, keyframes and the robot itself.
import {
  BufferAttribute, BufferGeometry, Color, DynamicDrawUsage, GridHelper, InterleavedBuffer, InterleavedBufferAttribute, Line, LineBasicMaterial,
  LineSegments, OrbitControls, PerspectiveCamera, Points, Quaternion, Scene, ShaderMaterial, Vector3, WebGLRenderer,
} from "/vendor/three.js";
import { set } from "/state.js";

const $ = (id) => document.getElementById(id);
const MOST_WAY = 20000, MOST_KEYFRAMES = 2000, FIRST_POINTS = 20000;
const SAMPLED = 3000; // landmarks that the extent is judged by
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

export class MapView {
  constructor() {
    this.canvas = $("map");
    this.view = "orbit";
    this.way = [];
    this.center = new Vector3();
    this.radius = 1;
    try {
      this.renderer = new WebGLRenderer({ canvas: this.canvas, antialias: true });
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
    if (4 * count > this.buffer.array.length) this.room(2 * count);
    this.buffer.array.set(points);
    this.buffer.clearUpdateRanges();
    this.buffer.addUpdateRange(0, points.length);
    this.buffer.needsUpdate = true;
    this.points.geometry.setDrawRange(0, count);
    this.metric = scale === 2;
    this.count = count;
    this.turnTo(epoch);
    this.measure(points, count);
    const left = total > count ? `, the newest of ${total}` : "";
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
    const step = Math.max(1, Math.floor(count / SAMPLED));
    const axes = [[], [], []];
    for (let i = 0; i < count; i += step) for (let a = 0; a < 3; a++) axes[a].push(points[4 * i + a]);
    if (axes[0].length === 0) return;
    axes.forEach((values) => values.sort((a, b) => a - b));
    const at = (a, share) => axes[a][Math.floor(share * (axes[a].length - 1))];
    const ends = [0, 1, 2].map((a) => [at(a, 0.05), at(a, 0.95)]);
    for (const { epoch, position } of this.way) {
      if (epoch === this.epoch) ends.forEach((end, a) => { [end[0], end[1]] = [Math.min(end[0], position[a]), Math.max(end[1], position[a])]; });
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
    const shown = Math.min(count, MOST_KEYFRAMES);
    const { array } = this.frusta.geometry.attributes.position;
    const [turn, place] = [new Quaternion(), new Vector3()];
    const size = this.radius * 0.035;
    for (let k = 0; k < shown; k++) {
      const [x, y, z, qx, qy, qz, qw] = keyframes.subarray(8 * (count - shown + k), 8 * (count - shown + k) + 7);
      turn.set(qx, qy, qz, qw);
      const corners = CORNERS.map((corner) => place.set(...corner).multiplyScalar(size).applyQuaternion(turn).toArray());
      EDGES.forEach((corner, e) => {
        const at = 3 * (k * EDGES.length + e);
        [array[at], array[at + 1], array[at + 2]] = [corners[corner][0] + x, corners[corner][1] + y, corners[corner][2] + z];
      });
    }
    this.frusta.geometry.attributes.position.needsUpdate = true;
    this.frusta.geometry.setDrawRange(0, shown * EDGES.length);
    this.turnTo(epoch);
    this.draw();
  }

  /** Positions of another epoch are out of place. */
  turnTo(epoch) {
    if (this.epoch === epoch) return;
    [this.taken, this.fitted] = [false, undefined];
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
      if (this.way.length > MOST_WAY) this.way.splice(0, this.way.length - MOST_WAY + 1000);
      this.robot.position.set(...sample.position);
      this.robot.quaternion.set(...sample.orientation);
      if (sample.epoch !== this.epoch) this.turnTo(sample.epoch);
      else this.drawWay();
      if (this.view === "follow") this.follow();
    }
    this.draw();
  }

  drawWay() {
    if (!this.renderer) return;
    const { position } = this.line.geometry.attributes;
    let n = 0;
    for (const s of this.way) {
      if (s.epoch !== this.epoch) continue;
      position.array.set(s.position, 3 * n);
      n += 1;
    }
    position.clearUpdateRanges();
    position.addUpdateRange(0, 3 * n);
    position.needsUpdate = true;
    this.line.geometry.setDrawRange(0, n);
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
    const ratio = Math.min(devicePixelRatio || 1, 2);
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
