// Messages of the console as values; docs/console.md describes their bytes.
export const KIND = {
  STATE: 1, POSES: 2, KEYFRAMES: 3, MAP: 4, FRAME: 5, LOG: 6, REPLY: 7, PICTURE: 8, HISTORY: 9, TIES: 10, COVISIBLE: 11, CALIBRATION: 12, OBSTACLES: 13, TAGS: 14,
};
export const EDGE = { COVISIBLE: 0, LOOP: 1, JOIN: 2 };
export const STATES = ["INITIALIZING", "TRACKING", "LOST", "ORIENTATION", "DEAD_RECKONING"];
const SAMPLE = 64;
const text = new TextDecoder();

export function parse(buffer) {
  const view = new DataView(buffer);
  const kind = view.getUint8(0);
  const count = view.getUint32(4, true);
  switch (kind) {
    case KIND.STATE: case KIND.LOG: case KIND.REPLY: case KIND.CALIBRATION:
      return { kind, value: JSON.parse(text.decode(new Uint8Array(buffer, 8))) };
    case KIND.POSES: case KIND.HISTORY:
      return { kind, samples: Array.from({ length: count }, (_, i) => sample(view, 8 + i * SAMPLE)) };
    case KIND.PICTURE:
      return { kind, value: JSON.parse(text.decode(new Uint8Array(buffer, 8, count))), png: new Uint8Array(buffer, 8 + count) };
    case KIND.MAP:
      return { kind, ...head(view), points: new Float32Array(buffer, 24, 4 * count) };
    case KIND.KEYFRAMES:
      return { kind, ...head(view), keyframes: new Float32Array(buffer, 24, 8 * count), ids: new Uint32Array(buffer, 24, 8 * count) };
    case KIND.TIES: case KIND.COVISIBLE:
      return { kind, ...head(view), edges: Array.from({ length: count }, (_, i) => edge(new Uint32Array(buffer, 24 + 20 * i, 5))) };
    case KIND.OBSTACLES:
      return { kind, count, ...obstacles(buffer, view, count) };
    case KIND.TAGS:
      return { kind, ...head(view), tags: Array.from({ length: count }, (_, i) => tag(buffer, 24 + 40 * i)) };
    case KIND.FRAME:
      return {
        kind, count, sequence: Number(view.getBigUint64(8, true)), time: view.getFloat64(16, true),
        width: view.getUint32(24, true), height: view.getUint32(28, true),
        features: new DataView(buffer, 32, 16 * count), jpeg: new Uint8Array(buffer, 32 + 16 * count),
      };
    default:
      return { kind }; // of a newer console
  }
}

function head(view) {
  return { count: view.getUint32(4, true), epoch: view.getUint32(8, true), total: view.getUint32(12, true), scale: view.getUint32(20, true) };
}

function obstacles(buffer, view, count) {
  const bearings = view.getUint32(20, true);
  const f = (at, n) => new Float32Array(buffer, at, n);
  const [angleMin, angleStep, rangeMin, rangeMax, robotHeight] = f(52, 5);
  return {
    epoch: view.getUint32(8, true), total: view.getUint32(12, true), told: view.getUint32(16, true), bearings, position: f(24, 3), orientation: f(36, 4),
    angleMin, angleStep, rangeMin, rangeMax, robotHeight, scan: f(72, 3 * bearings), points: f(72 + 12 * bearings, 4 * count),
  };
}

function tag(buffer, at) {
  const [x, y, z, ...rest] = new Float32Array(buffer, at, 8);
  const [id, isDock] = new Uint32Array(buffer, at + 32, 2);
  return { place: { x, y, z }, orientation: rest.slice(0, 4), side: rest[4], id, isDock: isDock === 1 };
}

function edge([from, to, shared, joined, kind]) {
  return { from, to, shared, joined, kind };
}

function sample(view, at) {
  const f = (i) => view.getFloat32(at + i, true);
  const u = (i) => view.getUint32(at + i, true);
  return {
    time: view.getFloat64(at, true), position: [f(8), f(12), f(16)], orientation: [f(20), f(24), f(28), f(32)],
    latency: f(36), quality: f(40), landmarks: u(44), sought: u(48), epoch: u(52), dropped: u(56),
    state: STATES[view.getUint8(at + 60)] ?? "UNKNOWN", scale: view.getUint8(at + 61), keyframe: view.getUint8(at + 62) !== 0,
  };
}
