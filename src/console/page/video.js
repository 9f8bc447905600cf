// The camera's picture with what was found in it.
import { set } from "/state.js";

const $ = (id) => document.getElementById(id);
const TAIL_S = 0.4; // how far back a track's tail reaches
const MATCHED = 1, NO_TRACK = 2; // flags of a feature
const STALE_MS = 1500;

export class Video {
  constructor(seen) {
    this.seen = seen;
    this.canvas = $("video");
    this.context = this.canvas.getContext("2d");
    this.tails = new Map(); // track -> [x, y, time, x, y, time, ...], newest last
    this.times = [];
    setInterval(() => this.look(), 500);
  }

  async frame(frame) {
    this.newest = performance.now();
    try {
      const picture = await createImageBitmap(new Blob([frame.jpeg], { type: "image/jpeg" }));
      // Two may be decoded at a time; corners belong to their own picture.
      const late = frame.sequence <= this.sequence && this.sequence - frame.sequence < 30;
      if (!late) {
        this.follow(frame);
        this.draw(picture, frame);
      }
      picture.close();
    } catch (error) {
      console.warn("a picture cannot be decoded", error);
    } finally {
      this.seen();
    }
  }

  /** Tails grow by this frame; those of tracks that have ended go. */
  follow({ features, count, sequence, time }) {
    if (!(sequence > this.sequence) || sequence - this.sequence > 30) this.tails.clear();
    this.sequence = sequence;
    const tails = new Map();
    this.features = [];
    for (let i = 0; i < count; i++) {
      const at = 16 * i;
      const [x, y] = [features.getFloat32(at, true), features.getFloat32(at + 4, true)];
      const [id, age, flags] = [features.getUint32(at + 8, true), features.getUint16(at + 12, true), features.getUint16(at + 14, true)];
      const isTrack = (flags & NO_TRACK) === 0;
      if (isTrack) {
        const tail = age > 0 ? this.tails.get(id) ?? [] : [];
        tail.push(x, y, time);
        while (tail.length > 6 && tail[2] < time - TAIL_S) tail.splice(0, 3);
        tails.set(id, tail);
      }
      this.features.push({ x, y, age, isTrack, isMatched: (flags & MATCHED) !== 0 });
    }
    this.tails = tails;
  }

  draw(picture, { width, height }) {
    const { canvas, context } = this;
    if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
    context.drawImage(picture, 0, 0);
    const size = Math.max(width / 640, 0.5);
    if ($("draw-tracks").checked) this.drawTails(size);
    if ($("draw-corners").checked) this.drawAll(size, "#ff3b30", (f) => f.isTrack && !f.isMatched, 2);
    if ($("draw-matches").checked) this.drawAll(size, "#30e070", (f) => f.isMatched, 3.2);
    this.count();
  }

  drawTails(size) {
    const { context } = this;
    context.beginPath();
    for (const tail of this.tails.values()) {
      context.moveTo(tail[0], tail[1]);
      for (let i = 3; i < tail.length; i += 3) context.lineTo(tail[i], tail[i + 1]);
    }
    context.strokeStyle = "#ffc531";
    context.lineWidth = 1.4 * size;
    context.stroke();
  }

  drawAll(size, colour, wanted, radius) {
    const { context } = this;
    const r = radius * size;
    context.beginPath();
    for (const f of this.features) if (wanted(f)) context.rect(f.x - r, f.y - r, 2 * r, 2 * r);
    context.strokeStyle = colour;
    context.lineWidth = 1.2 * size;
    context.stroke();
  }

  count() {
    const now = performance.now();
    this.times.push(now);
    this.times = this.times.filter((t) => t > now - 2000);
    this.shown = (this.shown ?? 0) + 1;
    this.canvas.dataset.frames = this.shown;
    $("video-empty").hidden = true;
  }

  look() {
    const old = performance.now() - (this.newest ?? -Infinity) > STALE_MS;
    this.canvas.parentElement.classList.toggle("stale", old);
    $("video-empty").hidden = !old;
    if (old && this.shown) set($("video-empty"), "No new picture comes.");
    const { width, height } = this.canvas;
    set($("video-rate"), old ? "" : `${width}×${height}, ${(this.times.length / 2).toFixed(0)} shown a second`);
  }
}
