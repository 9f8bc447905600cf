// The page from its sources, with a WebSocket that says what a test wants it to say: states that a daemon cannot be made to have at will, and maps
// larger than a demo's. `inPage` runs in the page, before its own code; `stage.hears` gets each word that the page says.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { gunzipSync } from "node:zlib";
import { open } from "./page.js";

const URL_OF_PAGE = "http://127.0.0.1:7979/";
const FOLDER = process.argv[3];
export const DESKTOP = { viewport: { width: 1360, height: 1000 } };
export const PHONE = { viewport: { width: 360, height: 780 }, deviceScaleFactor: 2, hasTouch: true };
const TYPES = { html: "text/html; charset=utf-8", js: "text/javascript", css: "text/css", svg: "image/svg+xml" };

export const text = (page, id) => page.locator(`#${id}`).innerText();

/** What the page draws next has been drawn. */
export const drawn = (page) => page.evaluate(() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done()))));

/** A page whose console is the stand-in. */
export async function begin(browser, options, query = "") {
  const page = await open(browser, `${URL_OF_PAGE}${query}`, options, standIn);
  await page.waitForFunction(() => window.stage.socket?.readyState === 1);
  return page;
}

/** It hears a robot at work. */
export async function busy(page) {
  await page.evaluate(async () => {
    const { stage } = window;
    for (let i = 0; i < 60; i++) stage.pose(i);
    stage.state("connected", "Tracking: the pose rests on landmarks seen in this frame.", stage.daemon());
    stage.say(stage.keyframes(40));
    stage.say(stage.map(3000));
    stage.obstacles();
    for (let i = 1; i < 9; i++) await stage.frame(i);
  });
  await page.waitForTimeout(300);
}

/** Serves the page's folder in place of a console. */
async function standIn(page) {
  await page.addInitScript(inPage);
  await page.route(`${URL_OF_PAGE}**`, (route) => {
    const { pathname } = new URL(route.request().url());
    if (pathname === "/access") return route.fulfill({ body: "open" });
    const file = pathname === "/" ? "index.html" : pathname.slice(1);
    const body = file === "vendor/three.js" ? gunzipSync(readFileSync(join(FOLDER, `${file}.gz`))) : readFileSync(join(FOLDER, file));
    return route.fulfill({ body, contentType: TYPES[file.split(".").at(-1)] });
  });
}

function inPage() {
  const stage = { sent: [], draws: [], work: [], pictures: [], cls: 0, shifts: [] };
  window.stage = stage;
  // Also refuses to be opened again once it is `gone`.
  window.WebSocket = class {
    static OPEN = 1;
    constructor() {
      this.readyState = 0;
      stage.socket = this;
      setTimeout(() => {
        if (stage.gone) return this.close();
        this.readyState = 1;
        this.onopen();
      });
    }
    send(text) {
      const word = JSON.parse(text);
      stage.sent.push(word);
      stage.hears?.(word);
    }
    close(code = 1006) {
      this.readyState = 3;
      this.onclose({ code });
    }
  };
  new PerformanceObserver((list) => {
    for (const entry of list.getEntries()) if (!entry.hadRecentInput) {
      stage.cls += entry.value;
      stage.shifts.push(...entry.sources.map((s) => s.node?.id || s.node?.parentElement?.id || s.node?.className || s.node?.nodeName));
    }
  }).observe({ type: "layout-shift", buffered: true });
  // What a picture of the screen costs the page's thread, and what it draws.
  const ask = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = (draw) => ask((time) => {
    const [began, drawn] = [performance.now(), stage.draws.length];
    draw(time);
    stage.work.push(performance.now() - began);
    stage.pictures.push(stage.draws.slice(drawn));
  });
  // A graphics card, as far as the page can tell.
  const extension = WebGL2RenderingContext.prototype.getExtension;
  WebGL2RenderingContext.prototype.getExtension = function (name) {
    return name === "WEBGL_debug_renderer_info" && location.search === "?card" ? null : extension.call(this, name);
  };
  const drawArrays = WebGL2RenderingContext.prototype.drawArrays;
  WebGL2RenderingContext.prototype.drawArrays = function (mode, first, count) {
    stage.draws.push(count);
    return drawArrays.call(this, mode, first, count);
  };

  /** The page hears it; how long that keeps it, ms. */
  stage.say = (message) => {
    const began = performance.now();
    stage.socket.onmessage({ data: message });
    return performance.now() - began;
  };
  const json = (kind, value) => {
    const text = new TextEncoder().encode(JSON.stringify(value));
    const view = head(kind, 0, 8 + text.length);
    new Uint8Array(view.buffer, 8).set(text);
    return stage.say(view.buffer);
  };
  const head = (kind, count, size) => {
    const view = new DataView(new ArrayBuffer(size));
    view.setUint8(0, kind);
    view.setUint32(4, count, true);
    return view;
  };
  stage.state = (link, sentence, daemon) => {
    return json(1, { link, sentence, prefix: "cairn", console_version: "0", daemon });
  };
  stage.calibration = (told) => json(12, told);
  stage.log = (records, replace = false) => json(6, { records, replace });
  /** What became of the order with this `id`. */
  stage.reply = (id, ok, text, more = {}) => json(7, { id, ok, text, terminal: "", chain: false, ...more });
  /** A picture of the two-picture chain, a PNG that the page itself makes. */
  stage.picture = async (name, width, height) => {
    const canvas = new OffscreenCanvas(width, height);
    const context = canvas.getContext("2d");
    context.fillStyle = "#666";
    context.fillRect(0, 0, width, height);
    context.fillStyle = "#30e070";
    for (let i = 0; i < 200; i++) context.fillRect((i * 97) % width, (i * 61) % height, 4, 4);
    const png = new Uint8Array(await (await canvas.convertToBlob({ type: "image/png" })).arrayBuffer());
    const said = new TextEncoder().encode(JSON.stringify({ name }));
    const view = head(8, said.length, 8 + said.length + png.length);
    new Uint8Array(view.buffer, 8).set(said);
    new Uint8Array(view.buffer, 8 + said.length).set(png);
    return stage.say(view.buffer);
  };
  stage.daemon = (more = {}) => ({
    version: "0.1.0", pid: 1, run_id: "1", uptime_s: 83, realtime_minus_monotonic_s: 0, state: "TRACKING", faults: [], frames_captured: 900,
    frames_dropped: 0, frames_corrupt: 0, frames_tracked: 880, keyframes: 40, landmarks: 3000, maps: 1, resets: 0, relocalisations: 0,
    maps_joined: 0, loops_closed: 0, frame_age_s: 0.01, pose_age_s: 0.01, rate_hz: 30, latency_p50_ms: 4.1, latency_p95_ms: 7.2,
    latency_p99_ms: 11.9, intrinsics: "CALIBRATED", lens_model: "RADIAL_TANGENTIAL", focal_px: [520, 520], focal_sigma: 0.01,
    scale: "UNKNOWN", scale_sigma: null, scale_source: [], ...more,
  });
  stage.pose = (i, epoch = 1, state = 1) => {
    const view = head(2, 1, 72);
    const angle = i / 60;
    view.setFloat64(8, i / 30, true);
    [2 * Math.cos(angle), 2 * Math.sin(angle), 0, 0, 0, Math.sin(angle / 2), Math.cos(angle / 2), 4 + Math.sin(i), 0.9]
      .forEach((v, k) => view.setFloat32(16 + 4 * k, v, true));
    [180, 200, epoch, 0].forEach((v, k) => view.setUint32(52 + 4 * k, v, true));
    view.setUint8(68, state);
    return stage.say(view.buffer);
  };
  // `move` of a place: what became of the map; (x, y, z) => [x, y, z].
  const same = (x, y, z) => [x, y, z];
  const list = (kind, element, count, epoch) => {
    const view = head(kind, count, 24 + element * count);
    [epoch, count, 1, 0].forEach((v, k) => view.setUint32(8 + 4 * k, v, true));
    return view.buffer;
  };
  /** A room: walls with windows, the same ones for the same count. */
  stage.map = (count, epoch = 1, move = same) => {
    const buffer = list(4, 16, count, epoch);
    const points = new Float32Array(buffer, 24);
    let seed = 1;
    const random = () => (seed = (seed * 48271) % 2147483647) / 2147483647;
    for (let i = 0; i < count; i++) {
      const [along, high, wall] = [8 * random() - 4, 2.5 * random() - 1, i % 4];
      const [x, y] = [[along, 4], [along, -4], [4, along], [-4, along]][wall];
      points.set(move(x + 0.05 * random(), y + 0.05 * random(), high), 4 * i);
    }
    return buffer;
  };
  stage.keyframes = (count, epoch = 1, move = same, turn = 0, firstId = 0) => {
    const buffer = list(3, 32, count, epoch);
    const [values, ids] = [new Float32Array(buffer, 24), new Uint32Array(buffer, 24)];
    for (let k = 0; k < count; k++) {
      const angle = (2 * Math.PI * k) / count;
      values.set(move(2 * Math.cos(angle), 2 * Math.sin(angle), 0.2 * Math.sin(3 * angle)), 8 * k);
      values.set([0, 0, Math.sin((angle + turn) / 2), Math.cos((angle + turn) / 2)], 8 * k + 3);
      ids[8 * k + 7] = firstId + k;
    }
    return buffer;
  };
  /** Loops and joins: [from, to, joined map, kind] each. */
  stage.ties = (ties, epoch = 1) => {
    const buffer = list(10, 20, ties.length, epoch);
    ties.forEach(([from, to, joined, kind], i) => new Uint32Array(buffer, 24 + 20 * i, 5).set([from, to, 30, joined, kind]));
    return stage.say(buffer);
  };
  /** Tags: [id, x, y, yaw of who looks at it, side, whether it is the dock] each; `waiting` more are not placed. */
  stage.tags = (tags, waiting = 0, epoch = 1) => {
    const buffer = list(14, 40, tags.length, epoch);
    new Uint32Array(buffer, 12, 1)[0] = tags.length + waiting;
    tags.forEach(([id, x, y, yaw, side, isDock], i) => {
      new Float32Array(buffer, 24 + 40 * i, 8).set([x, y, 0.3, 0, 0, Math.sin(yaw / 2), Math.cos(yaw / 2), side]);
      new Uint32Array(buffer, 56 + 40 * i, 2).set([id, isDock ? 1 : 0]);
    });
    return stage.say(buffer);
  };
  /** Things on an arc before the robot, and the floor free up to half a metre before them; nothing is known behind it. `told` as on the wire. */
  stage.obstacles = (told = 0, epoch = 1) => {
    const [bearings, count] = [180, told === 0 ? 60 : 0];
    const view = head(13, count, 72 + 12 * bearings + 16 * count);
    [epoch, count, told, bearings].forEach((v, k) => view.setUint32(8 + 4 * k, v, true));
    const floats = new Float32Array(view.buffer, 24);
    floats.set([0.5, 0.5, -0.9, 0, 0, 0, 1, -Math.PI, (2 * Math.PI) / bearings, 0.05, 5, 1]);
    for (let i = 0; i < bearings; i++) {
      const isAhead = told === 0 && i >= 60 && i < 120;
      floats.set(isAhead ? [2, 0.4, 1.5] : [NaN, NaN, 0], 12 + 3 * i);
    }
    for (let i = 0; i < count; i++) {
      const angle = (-60 + 2 * i) * (Math.PI / 180);
      floats.set([2 * Math.cos(angle), 2 * Math.sin(angle), (i % 10) / 10, 0.05], 12 + 3 * bearings + 4 * i);
    }
    return stage.say(view.buffer);
  };
  /** A grey picture with features, as a JPEG that the page itself makes. */
  stage.frame = async (sequence) => {
    const canvas = new OffscreenCanvas(640, 480);
    const context = canvas.getContext("2d");
    context.fillStyle = "#777";
    context.fillRect(0, 0, 640, 480);
    for (let i = 0; i < 60; i++) {
      context.fillStyle = `rgb(${(i * 37) % 200 + 30} ${(i * 37) % 200 + 30} ${(i * 37) % 200 + 30})`;
      context.fillRect((i * 97) % 640, (i * 61) % 480, 60, 40);
    }
    const jpeg = new Uint8Array(await (await canvas.convertToBlob({ type: "image/jpeg" })).arrayBuffer());
    const features = 200;
    const view = head(5, features, 32 + 16 * features + jpeg.length);
    view.setBigUint64(8, BigInt(sequence), true);
    view.setFloat64(16, sequence / 30, true);
    view.setUint32(24, 640, true);
    view.setUint32(28, 480, true);
    for (let i = 0; i < features; i++) {
      view.setFloat32(32 + 16 * i, ((i * 97) % 640) + sequence % 7, true);
      view.setFloat32(36 + 16 * i, (i * 61) % 480, true);
      view.setUint32(40 + 16 * i, i, true);
      view.setUint16(44 + 16 * i, sequence, true);
      view.setUint16(46 + 16 * i, i % 2, true);
    }
    new Uint8Array(view.buffer, 32 + 16 * features).set(jpeg);
    return stage.say(view.buffer);
  };
}
