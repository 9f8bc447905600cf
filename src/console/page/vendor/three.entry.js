export {
  BufferAttribute, BufferGeometry, Color, DynamicDrawUsage, GridHelper, InterleavedBuffer, InterleavedBufferAttribute, Line, LineBasicMaterial,
  LineSegments, Mesh, PerspectiveCamera, Points, Quaternion, Scene, ShaderMaterial, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
