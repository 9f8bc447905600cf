// Pictures of a calibration: the live one with the board's corners, and what the views cover.
const GOOD = "#30e070", WAIT = "#ffc531", WRONG = "#ff6a62", HINT = "#7fb0ff";
const COLOUR = { taken: GOOD, known: GOOD, unfit: WAIT };
const RIM = 0.15; // the outer share of the picture that corners must reach, as the verdict has it
const KEPT = 8; // pictures that wait for what was found in them
const PATIENCE_MS = 350; // without news of the board the picture goes on alone
const NEAR = 6; // frames between a picture and corners that are shown on it all the same

export class BoardPicture {
  /** seen(): a picture was dealt with. */
  constructor(canvas, empty, seen) {
    Object.assign(this, { canvas, empty, seen, recent: new Map(), glance: null, need: "", running: false });
    this.context = canvas.getContext("2d");
    this.drawn = 0;
    setInterval(() => this.look(), 500);
  }

  async frame(frame) {
    this.newest = performance.now();
    try {
      const picture = await createImageBitmap(new Blob([frame.jpeg], { type: "image/jpeg" }));
      this.recent.set(frame.sequence, picture);
      while (this.recent.size > KEPT) this.drop(this.recent.keys().next().value);
      const waits = performance.now() - this.drawn < PATIENCE_MS;
      if (!this.running) this.draw(picture, null);
      else if (this.glance?.sequence === frame.sequence) this.draw(picture, this.glance);
      else if (!waits) this.draw(picture, Math.abs(frame.sequence - this.glance?.sequence) <= NEAR ? this.glance : null);
    } catch (error) {
      console.warn("a picture cannot be decoded", error);
    } finally {
      this.seen();
    }
  }

  drop(sequence) {
    this.recent.get(sequence).close();
    this.recent.delete(sequence);
  }

  /** What was found in one of the pictures, and the edge that no view has reached. */
  found(running, glance, need) {
    const news = glance && glance.sequence !== this.glance?.sequence;
    Object.assign(this, { running, glance, need });
    const picture = news && this.recent.get(glance.sequence);
    if (running && picture) this.draw(picture, glance);
  }

  draw(picture, glance) {
    const { canvas, context } = this;
    const { width, height } = picture;
    if (canvas.width !== width || canvas.height !== height) {
      [canvas.width, canvas.height] = [width, height];
      canvas.parentElement.style.aspectRatio = `${width} / ${height}`;
    }
    context.drawImage(picture, 0, 0);
    if (this.running) this.hint(width, height);
    if (glance) this.corners(glance, Math.max(width / 640, 0.5));
    this.drawn = performance.now();
    canvas.dataset.frames = Number(canvas.dataset.frames ?? 0) + 1;
    canvas.dataset.corners = glance ? glance.corners.reduce((sum, row) => sum + row.length / 2, 0) : 0;
  }

  corners({ corners, look }, size) {
    const { context } = this;
    context.strokeStyle = context.fillStyle = COLOUR[look] ?? WRONG;
    context.lineWidth = 1.6 * size;
    context.lineJoin = "round";
    const line = (points) => {
      context.beginPath();
      for (let i = 0; i < points.length; i += 2) context.lineTo(points[i], points[i + 1]);
      context.stroke();
    };
    corners.forEach(line);
    // The columns, where the board is whole.
    const whole = corners.length > 0 && corners.every((row) => row.length === corners[0].length);
    for (let i = 0; whole && i < corners[0].length; i += 2) line(corners.flatMap((row) => [row[i], row[i + 1]]));
    context.beginPath();
    for (const row of corners) {
      for (let i = 0; i < row.length; i += 2) {
        context.moveTo(row[i] + 2.6 * size, row[i + 1]);
        context.arc(row[i], row[i + 1], 2.6 * size, 0, 7);
      }
    }
    context.fill();
    if (look === "taken" && whole) {
      const [first, last] = [corners[0], corners.at(-1)];
      context.globalAlpha = 0.35;
      context.beginPath();
      for (const [x, y] of [first.slice(0, 2), first.slice(-2), last.slice(-2), last.slice(0, 2)]) context.lineTo(x, y);
      context.fill();
      context.globalAlpha = 1;
    }
  }

  /** Where the board is to be brought. */
  hint(width, height) {
    const zone = {
      left: [0, 0, RIM * width, height], right: [(1 - RIM) * width, 0, RIM * width, height],
      top: [0, 0, width, RIM * height], bottom: [0, (1 - RIM) * height, width, RIM * height],
    }[this.need];
    if (!zone) return;
    const { context } = this;
    context.fillStyle = context.strokeStyle = HINT;
    context.globalAlpha = 0.28;
    context.fillRect(...zone);
    context.globalAlpha = 1;
    context.lineWidth = Math.max(width / 320, 1);
    context.setLineDash([width / 40, width / 60]);
    context.strokeRect(...zone);
    context.setLineDash([]);
  }

  look() {
    const old = performance.now() - (this.newest ?? -Infinity) > 1500;
    this.canvas.parentElement.classList.toggle("stale", old);
    this.empty.hidden = !old;
    const text = this.canvas.dataset.frames ? "No new picture comes." : "No picture yet.";
    if (old && this.empty.textContent !== text) this.empty.textContent = text;
  }
}

/** The picture as a map: cells with corners, the views' boards, edges that no view reaches. */
export class Coverage {
  constructor(canvas) {
    this.canvas = canvas;
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  show(guidance, aspect) {
    this.guidance = guidance;
    if (aspect) this.canvas.style.aspectRatio = `${aspect}`;
    this.draw();
    const missing = guidance.needs.map((need) => need.missing).join("; ");
    this.canvas.setAttribute("aria-label", `What ${guidance.views} views cover. ${missing}`);
  }

  draw() {
    const { canvas, guidance } = this;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (!guidance || width === 0) return;
    const ratio = devicePixelRatio || 1;
    [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    const c = canvas.getContext("2d");
    c.scale(ratio, ratio);
    const style = getComputedStyle(canvas);
    const colour = (name) => style.getPropertyValue(name);
    const [columns, rows] = guidance.grid;
    guidance.cells.forEach((count, i) => {
      c.fillStyle = colour(count > 0 ? "--covered" : "--stage");
      c.fillRect((i % columns) * width / columns + 0.5, Math.floor(i / columns) * height / rows + 0.5, width / columns - 1, height / rows - 1);
    });
    c.strokeStyle = colour("--accent");
    c.lineJoin = "round";
    guidance.outlines.forEach((outline, i) => {
      const newest = i === guidance.outlines.length - 1;
      c.globalAlpha = newest ? 1 : 0.45;
      c.lineWidth = newest ? 2 : 1;
      c.beginPath();
      for (let k = 0; k < 8; k += 2) c.lineTo(outline[k] * width, outline[k + 1] * height);
      c.closePath();
      c.stroke();
    });
    c.globalAlpha = 1;
    c.fillStyle = colour("--bad");
    const edge = { left: [0, 0, 4, height], right: [width - 4, 0, 4, height], top: [0, 0, width, 4], bottom: [0, height - 4, width, 4] };
    for (const need of guidance.needs) if (edge[need.name]) c.fillRect(...edge[need.name]);
  }
}
