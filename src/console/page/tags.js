// Tags where they hang, in their true size, each with its number.
import { BufferAttribute, BufferGeometry, Color, DynamicDrawUsage, LineBasicMaterial, LineSegments, Mesh, Quaternion, ShaderMaterial, Vector3 } from "/vendor/three.js";
import { set } from "/state.js";

const $ = (id) => document.getElementById(id);
const MOST_TAGS = 16; // of the wire
// Corners of a square of side 1: x goes into the tag, y to the left, z up. Two triangles, four sides.
const CORNERS = [[0, 0.5, 0.5], [0, -0.5, 0.5], [0, -0.5, -0.5], [0, 0.5, -0.5]];
const FACES = [0, 1, 2, 0, 2, 3], SIDES = [0, 1, 1, 2, 2, 3, 3, 0];
const BOTH_SIDES = 2; // three's DoubleSide
const FACE = {
  vertexShader: "void main() { gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }",
  fragmentShader: "uniform vec3 tag; void main() { gl_FragColor = vec4(tag, 0.35); }",
};

export class TagView {
  /** map: the MapView that they are drawn in. */
  constructor(map) {
    this.map = map;
    this.names = [];
    if (!map.renderer) return;
    this.faces = this.add(new Mesh(this.room(FACES), new ShaderMaterial({ ...FACE, uniforms: { tag: { value: new Color() } }, side: BOTH_SIDES, transparent: true, depthWrite: false })));
    this.sides = this.add(new LineSegments(this.room(SIDES), new LineBasicMaterial()));
    map.afterDrawing = () => this.placeNames();
    this.colours();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.colours());
  }

  room(order) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(3 * MOST_TAGS * order.length), 3).setUsage(DynamicDrawUsage));
    geometry.setDrawRange(0, 0);
    return geometry;
  }

  add(object) {
    object.frustumCulled = false;
    this.map.scene.add(object);
    return object;
  }

  colours() {
    const colour = getComputedStyle(this.map.canvas).getPropertyValue("--tag").trim();
    this.sides.material.color.set(colour);
    // As it is to be seen: the shader writes it without a conversion.
    this.faces.material.uniforms.tag.value.set(colour).convertLinearToSRGB();
    this.map.draw();
  }

  tell(message) {
    this.message = message;
    this.show();
  }

  /** Another start of the daemon, or another map, to which they are told anew. */
  forget() {
    if (this.message) this.tell(null);
  }

  show() {
    const { tags = [], total = 0, epoch } = this.message ?? {};
    const waiting = total - tags.length;
    set($("tag-count"), total > 0 ? `${total} tag${total > 1 ? "s" : ""}${waiting > 0 ? `, ${waiting} not placed yet` : ""}` : "");
    if (!this.sides) return;
    // In coordinates of another map, or of one that was corrected since, they would be out of place.
    const here = epoch === this.map.epoch ? tags.slice(0, MOST_TAGS) : [];
    const [turn, corner] = [new Quaternion(), new Vector3()];
    for (const [{ geometry }, order] of [[this.faces, FACES], [this.sides, SIDES]]) {
      const { position } = geometry.attributes;
      here.forEach(({ place, orientation, side }, i) => order.forEach((c, k) => {
        corner.fromArray(CORNERS[c]).multiplyScalar(side).applyQuaternion(turn.set(...orientation)).add(place);
        corner.toArray(position.array, 3 * (i * order.length + k));
      }));
      position.needsUpdate = true;
      geometry.setDrawRange(0, here.length * order.length);
    }
    this.names = here.map(({ place, id, isDock }) => ({ place, element: Object.assign(document.createElement("span"), { textContent: `${id}${isDock ? " dock" : ""}` }) }));
    $("tag-names").replaceChildren(...this.names.map(({ element }) => element));
    this.map.canvas.dataset.tags = here.length;
    this.map.draw();
  }

  /** Beside their squares, wherever the eye is. */
  placeNames() {
    const { camera, canvas } = this.map;
    for (const { place, element } of this.names) {
      const at = new Vector3().copy(place).project(camera);
      element.hidden = !(Math.abs(at.x) < 1 && Math.abs(at.y) < 1 && at.z < 1);
      element.style.transform = `translate(${((at.x + 1) / 2) * canvas.clientWidth}px, ${((1 - at.y) / 2) * canvas.clientHeight}px)`;
    }
  }
}
