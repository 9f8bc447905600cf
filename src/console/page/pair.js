// The two-picture chain: two pictures, each step's picture and numbers, and the run before beside it.
import { quoted } from "/controls.js";

const $ = (id) => document.getElementById(id);
const LABEL = 18; // characters of a line's name in the text of `cairn twoview`

const STEPS = [
  { title: "Corners", names: ["corners", "tilted views"], pictures: ["corners_a", "corners_b"], says: "Places that can be found again: the picture changes there in every direction. A hand shows which way each points." },
  { title: "Attributes", names: ["attributes"], pictures: ["attributes"], says: "What is kept of each corner: its grey level, how little of its surroundings looks like it (salient degree), and its direction." },
  { title: "Matches", names: ["matches", "guided matches", "first try"], pictures: ["matches"], says: "Corners that look alike in both pictures; green ones agree with the geometry that follows." },
  { title: "Fundamental matrix F", names: ["F"], pictures: ["epipolar"], says: "A point of one picture lies on a line of the other: F says on which. It needs no calibration." },
  { title: "Essential matrix E", names: ["E from F and K"], pictures: [], says: "With the lens known F becomes E = KᵀFK; two of its singular values are equal and the third is zero." },
  { title: "Four motions and their votes", names: ["its motions", "E by five points", "judge"], pictures: ["motions"], says: "Four motions explain E. A real point lies before both cameras: each match votes (cheirality), and one motion wins." },
  { title: "Triangulation", names: ["triangulation", "parallax"], pictures: ["distances"], says: "Each match's two rays meet at a point; how far away it lies is counted in baselines, the way between the cameras." },
  { title: "Adjustment", names: ["adjustment", "second_from_first", "F of the motion"], pictures: [], says: "Motion and points are adjusted together until their errors in the pictures are smallest." },
  { title: "The scene in 3D", names: [], pictures: ["scene"], says: "Blue the points, red the two cameras." },
  { title: "Outcome", names: ["outcome"], pictures: [], says: "" },
];

export class PairView {
  constructor(say) {
    this.say = say;
    this.id = 1_000_000; // apart from the commands'
    this.images = {};
    for (const which of ["a", "b"]) $(`take-${which}`).addEventListener("click", () => this.ask({ take: { which } }, `Picture ${which.toUpperCase()} …`));
    $("chain").addEventListener("submit", (event) => {
      event.preventDefault();
      this.images = {};
      this.ask({ chain: { method: this.method() } }, "The chain runs …");
    });
    $("chain").addEventListener("input", () => this.shell());
    this.setPrefix("cairn");
  }

  method() {
    return { detector: $("detector").value, matcher: $("matcher").value, guided: $("guided").checked };
  }

  setPrefix(prefix) {
    if (prefix === this.prefix) return;
    this.prefix = prefix;
    this.shell();
  }

  /** The same on a terminal. */
  shell() {
    const of = this.prefix === "cairn" ? "" : ` --prefix ${quoted(this.prefix)}`;
    for (const which of ["a", "b"]) $(`shell-${which}`).textContent = `cairn watch${of} --picture ${which}.png --camera camera.txt`;
    const { detector, matcher, guided } = this.method();
    $("shell-chain").textContent = `cairn twoview a.png b.png --detector ${detector} --matcher ${matcher} --output two --camera camera.txt${guided ? " --guided" : ""}`;
  }

  ask(word, text) {
    this.id += 1;
    const [[name, value]] = Object.entries(word);
    this.say({ [name]: { id: this.id, ...value } });
    this.tell(text);
    this.busy(true);
  }

  busy(busy) {
    for (const button of document.querySelectorAll("#pair button")) button.disabled = busy;
  }

  tell(text) {
    $("pair-says").textContent = text;
  }

  /** A picture that was taken, or that a step left. */
  picture({ value, png }) {
    const url = URL.createObjectURL(new Blob([png], { type: "image/png" }));
    if (value.name === "a" || value.name === "b") {
      const image = $(`picture-${value.name}`);
      URL.revokeObjectURL(image.src);
      image.src = url;
      image.hidden = false;
      image.nextElementSibling.hidden = true;
    } else this.images[value.name] = url;
  }

  reply({ id, ok, text, terminal, chain }) {
    if (id !== this.id) return;
    this.busy(false);
    if (!chain || !ok) return this.tell(text);
    this.tell("");
    const results = $("results");
    // The run before stays beside this one.
    while (results.childElementCount > 1) {
      for (const image of results.firstElementChild.querySelectorAll("img")) URL.revokeObjectURL(image.src);
      results.firstElementChild.remove();
    }
    results.append(this.result(text, terminal));
  }

  /** The connection has gone, and what was asked with it. */
  lost() {
    this.busy(false);
    this.tell("");
  }

  result(text, terminal) {
    const lines = text.split("\n").map((line) => ({ name: line.slice(0, LABEL).trim(), text: line.slice(LABEL) }));
    // A line without a name goes on with the one before.
    lines.forEach((line, i) => { line.of = line.name || lines[i - 1]?.of; });
    const article = document.createElement("article");
    const code = Object.assign(document.createElement("code"), { textContent: terminal });
    article.append(code);
    for (const [row, step] of STEPS.entries()) {
      const said = lines.filter((line) => step.names.includes(line.of));
      const images = step.pictures.filter((name) => this.images[name]);
      if (said.length + images.length === 0) continue;
      const section = document.createElement("section");
      // Beside the same step of the other run.
      section.style.setProperty("--row", row + 2);
      section.append(Object.assign(document.createElement("h3"), { textContent: step.title }));
      if (step.says) section.append(Object.assign(document.createElement("p"), { textContent: step.says }));
      if (said.length > 0) section.append(Object.assign(document.createElement("pre"), { textContent: said.map((line) => `${line.name ? `${line.name}: ` : ""}${line.text}`).join("\n") }));
      for (const name of images) section.append(Object.assign(document.createElement("img"), { src: this.images[name], alt: `${step.title}, ${name.replace("_", " ")}`, className: "step" }));
      article.append(section);
    }
    return article;
  }
}
