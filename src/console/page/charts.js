// Small charts of the last minutes.
const SPAN_S = 180, LEAST_S = 30, EVERY_S = 0.2;

export class Chart {
  constructor(canvas, label, { value, unit, digits, colour }) {
    Object.assign(this, { canvas, label, value, unit, digits, colour, points: [] });
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  replace(samples) {
    this.points = [];
    samples.forEach((s) => this.add(s));
  }

  add(sample) {
    const last = this.points.at(-1);
    if (last && sample.time < last.time) this.points = []; // another machine's clock
    else if (last && sample.time - last.time < EVERY_S) return;
    this.points.push({ time: sample.time, value: this.value(sample) });
    while (this.points[0].time < sample.time - SPAN_S) this.points.shift();
  }

  draw() {
    const { canvas, points } = this;
    const ratio = devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    if (width === 0) return;
    if (canvas.width !== Math.round(width * ratio)) [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    const style = getComputedStyle(canvas);
    const colour = (name) => style.getPropertyValue(name);
    const finite = points.filter((p) => Number.isFinite(p.value));
    const top = nice(Math.max(1, ...finite.map((p) => p.value)));
    const now = points.at(-1)?.time ?? 0;
    const [left, bottom] = [42, height - 16];
    const span = Math.min(SPAN_S, Math.max(LEAST_S, now - (points[0]?.time ?? now)));
    const x = (t) => left + (width - left - 4) * (1 - (now - t) / span);
    const y = (v) => bottom - (bottom - 6) * Math.min(v / top, 1);
    c.font = "11px system-ui, sans-serif";
    c.fillStyle = colour("--quiet");
    c.strokeStyle = colour("--line");
    c.lineWidth = 1;
    c.textAlign = "right";
    c.textBaseline = "middle";
    for (const v of [0, top / 2, top]) {
      c.beginPath();
      c.moveTo(left, Math.round(y(v)) + 0.5);
      c.lineTo(width, Math.round(y(v)) + 0.5);
      c.stroke();
      c.fillText(`${v}`, left - 5, y(v));
    }
    c.textBaseline = "alphabetic";
    c.textAlign = "left";
    c.fillText(span < SPAN_S ? `${Math.round(span)} s ago` : "3 min ago", left, height - 3);
    c.textAlign = "right";
    c.fillText("now", width - 2, height - 3);
    c.beginPath();
    let before = -Infinity;
    for (const p of finite) {
      // A gap is a gap.
      if (p.time - before > 1.5) c.moveTo(x(p.time), y(p.value));
      else c.lineTo(x(p.time), y(p.value));
      before = p.time;
    }
    c.strokeStyle = colour(this.colour);
    c.lineWidth = 1.6;
    c.lineJoin = "round";
    c.stroke();
    const last = this.isAway ? undefined : finite.at(-1);
    const text = last ? `${last.value.toFixed(this.digits)}${this.unit}` : "–";
    if (this.label.textContent !== text) this.label.textContent = text;
  }
}

/** The next of 1, 2, 4, 5, 10, 20, ... */
function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 4, 5, 10].map((m) => m * power).find((v) => v >= value) ?? 10 * power;
}
