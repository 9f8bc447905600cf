// What stands around the robot, and where the floor is free, as the daemon tells it; what is not known is left empty.
import { BufferAttribute, BufferGeometry, Color, DynamicDrawUsage, Mesh, Points, ShaderMaterial } from "/vendor/three.js";
import { set } from "/state.js";

const $ = (id) => document.getElementById(id);
const OLD_MS = 5000;
const MOST_POINTS = 500, MOST_BEARINGS = 360; // of the wire: 500 and 180
const POINT_PX = 5;
const LIFT_M = 0.01; // the free floor above the grid
const TOLD = 0;
const WHY = { 1: "the robot has no pose", 2: "the map has no metres", 3: "the floor is not known" };
const COLOURS = { low: ["#c25a00", "#ff9e3d"], high: ["#7a1400", "#ffe08a"], free: ["#17883f", "#4fd483"] };

const POINTS = {
  vertexShader: `
    uniform float size, top;
    varying float height;
    void main() {
      height = clamp(position.z / top, 0.0, 1.0);
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
      gl_PointSize = size;
    }`,
  fragmentShader: `
    uniform vec3 low, high;
    varying float height;
    void main() { gl_FragColor = vec4(mix(low, high, height), 1.0); }`,
};
const FREE = {
  vertexShader: "void main() { gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }",
  fragmentShader: "uniform vec3 free; void main() { gl_FragColor = vec4(free, 0.28); }",
};

export class ObstacleView {
  /** map: the MapView that it is drawn in; changed(): what is asked for is another. */
  constructor(map, changed) {
    this.map = map;
    $("draw-obstacles").addEventListener("change", () => {
      this.message = null;
      this.show();
      changed();
    });
    this.show();
    if (!map.renderer) return;
    const colours = (names) => Object.fromEntries(names.map((name) => [name, { value: new Color() }]));
    const size = { value: POINT_PX * Math.min(devicePixelRatio || 1, 2) };
    this.points = this.add(new Points(this.room(MOST_POINTS), new ShaderMaterial({ ...POINTS, uniforms: { ...colours(["low", "high"]), size, top: { value: 1 } } })));
    this.free = this.add(new Mesh(this.room(6 * MOST_BEARINGS), new ShaderMaterial({ ...FREE, uniforms: colours(["free"]), transparent: true, depthWrite: false })));
    this.colours();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.colours());
  }

  room(count) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(3 * count), 3).setUsage(DynamicDrawUsage));
    return geometry;
  }

  add(object) {
    object.frustumCulled = object.visible = false;
    this.map.scene.add(object);
    return object;
  }

  get isWanted() {
    return $("draw-obstacles").checked;
  }

  colours() {
    const dark = Number(matchMedia("(prefers-color-scheme: dark)").matches);
    // As they are to be seen: the shaders write them without a conversion.
    for (const { material } of [this.points, this.free]) {
      for (const [name, pair] of Object.entries(COLOURS)) material.uniforms[name]?.value.set(pair[dark]).convertLinearToSRGB();
    }
    this.map.draw();
  }

  scan(message) {
    this.message = message;
    this.show();
    // Scans come several times a second; without a camera there are none, and what stood there then may have moved.
    clearTimeout(this.ageing);
    this.ageing = setTimeout(() => this.forget(), OLD_MS);
  }

  /** Another start of the daemon, or none that is heard: what stood there then may have moved. */
  forget() {
    if (!this.message) return;
    this.message = null;
    this.show();
  }

  show() {
    // One that was under way when the box was cleared is not drawn.
    const message = this.isWanted ? this.message : null;
    const isTold = message?.told === TOLD;
    $("obstacle-says").hidden = !message;
    if (isTold) set($("obstacle-count"), `${message.count}${message.total > message.count ? ` of ${message.total}` : ""} obstacle points`);
    else if (message) set($("obstacle-count"), `No obstacles told: ${WHY[message.told] ?? "a newer daemon says why"}`);
    $("obstacle-key").hidden = !isTold;
    if (isTold) set($("obstacle-top"), `${message.robotHeight.toFixed(1)} m`);
    if (!this.points) return;
    // In coordinates of another map, or of one that was corrected since, it would be out of place.
    const isHere = isTold && message.epoch === this.map.epoch;
    const [points, bearings] = isHere ? [this.drawPoints(message), this.drawFree(message)] : [0, 0];
    for (const object of [this.points, this.free]) {
      object.visible = isHere;
      if (!isHere) continue;
      object.position.set(...message.position);
      object.quaternion.set(...message.orientation);
    }
    [this.map.canvas.dataset.obstacles, this.map.canvas.dataset.free] = [points, bearings];
    this.map.draw();
  }

  drawPoints({ points, count, robotHeight }) {
    const { geometry, material } = this.points;
    const { position } = geometry.attributes;
    const drawn = Math.min(count, MOST_POINTS);
    for (let i = 0; i < drawn; i++) for (let a = 0; a < 3; a++) position.array[3 * i + a] = points[4 * i + a];
    position.needsUpdate = true;
    geometry.setDrawRange(0, drawn);
    material.uniforms.top.value = robotHeight;
    return drawn;
  }

  /** A sector of each bearing, from where the floor is free to where it is no more; how many. */
  drawFree({ scan, bearings, angleMin, angleStep }) {
    const { geometry } = this.free;
    const { position } = geometry.attributes;
    let n = 0;
    for (let i = 0; i < Math.min(bearings, MOST_BEARINGS); i++) {
      const [from, to] = [scan[3 * i + 1], scan[3 * i + 2]];
      // Written so that NaN is not free.
      if (!(to > from)) continue;
      const corner = (r, side) => {
        const angle = angleMin + (i + side) * angleStep;
        return [r * Math.cos(angle), r * Math.sin(angle), LIFT_M];
      };
      // Counter-clockwise from above, and from below it is not seen: there is no floor to look through.
      const [a, b, c, d] = [corner(from, -0.5), corner(to, -0.5), corner(to, 0.5), corner(from, 0.5)];
      position.array.set([...a, ...b, ...c, ...a, ...c, ...d], 18 * n++);
    }
    position.needsUpdate = true;
    geometry.setDrawRange(0, 6 * n);
    return n;
  }
}
