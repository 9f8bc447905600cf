// Brings the page's parts together.
import { KIND } from "/wire.js";
import { Link } from "/link.js";
import { StateView, set } from "/state.js";
import { Video } from "/video.js";
import { MapView } from "/map.js";
import { Chart } from "/charts.js";
import { Controls } from "/controls.js";
import { GraphView } from "/graph.js";
import { ObstacleView } from "/obstacles.js";
import { TagView } from "/tags.js";
import { CameraView } from "/camera.js";
import { Log } from "/log.js";
import { PairView } from "/pair.js";
import { Calibration } from "/calibrate.js";

const $ = (id) => document.getElementById(id);
const PARTS = { live: ["video", "map"], pair: [], calibrate: ["video", "calibration"], log: ["log"] };

const state = new StateView();
const controls = new Controls((word) => link.say(word));
const log = new Log();
const pair = new PairView((word) => link.say(word));
const calibration = new Calibration((word) => link.say(word), () => link.seen(KIND.FRAME));
const video = new Video(() => link.seen(KIND.FRAME));
const map = new MapView();
const graph = new GraphView(map, () => turn());
const obstacles = new ObstacleView(map, () => turn());
const tags = new TagView(map);
const camera = new CameraView((word) => link.say(word));
const charts = [
  new Chart($("latency"), $("latency-now"), { value: (s) => s.latency, unit: " ms", digits: 1, colour: "--accent" }),
  new Chart($("landmarks"), $("landmarks-now"), { value: (s) => s.landmarks, unit: "", digits: 0, colour: "--good" }),
];

function setAway(isAway, state) {
  map.setAway(isAway, state);
  if (isAway) {
    obstacles.forget();
    tags.forget();
  }
  // What was last is not what is now.
  charts.forEach((chart) => { chart.isAway = isAway; });
}

const receive = {
  [KIND.STATE]: ({ value }) => {
    controls.setPrefix(value.prefix);
    camera.setPrefix(value.prefix);
    pair.setPrefix(value.prefix);
    calibration.setPrefix(value.prefix);
    if (value.daemon) {
      camera.turnTo(value.daemon.run_id);
      graph.turnTo(value.daemon.run_id);
    }
    const trouble = state.report(value);
    set($("banner"), trouble);
    setAway(trouble !== "", value.daemon?.state);
  },
  [KIND.HISTORY]: ({ samples }) => {
    charts.forEach((chart) => chart.replace(samples));
    map.history(samples);
  },
  [KIND.POSES]: ({ samples }) => samples.forEach((sample) => {
    state.sample(sample);
    map.pose(sample);
    charts.forEach((chart) => chart.add(sample));
  }),
  [KIND.FRAME]: (frame) => ($("calibrate").hidden ? video : calibration).frame(frame),
  [KIND.CALIBRATION]: ({ value }) => calibration.told(value),
  [KIND.MAP]: (message) => {
    map.landmarks(message);
    link.seen(KIND.MAP);
  },
  [KIND.KEYFRAMES]: (message) => {
    map.keyframes(message);
    graph.keyframes(message);
    tags.show();
  },
  [KIND.TIES]: (message) => graph.edges(message, false),
  [KIND.COVISIBLE]: (message) => {
    graph.edges(message, true);
    link.seen(KIND.COVISIBLE);
  },
  [KIND.OBSTACLES]: (message) => obstacles.scan(message),
  [KIND.TAGS]: (message) => tags.tell(message),
  [KIND.REPLY]: ({ value }) => {
    controls.reply(value);
    camera.reply(value);
    pair.reply(value);
    calibration.reply(value);
  },
  [KIND.PICTURE]: (message) => pair.picture(message),
  [KIND.LOG]: ({ value }) => log.add(value),
};

const link = new Link({
  message: (message) => receive[message.kind]?.(message),
  status: (sentence) => {
    // Answers of the connection before do not come any more, now that there is another one either.
    controls.lost();
    camera.lost();
    pair.lost();
    calibration.lost();
    if (sentence === "") return;
    set($("banner"), sentence);
    state.away();
    setAway(true);
    set($("state"), "no console");
    $("state").dataset.state = "NONE";
  },
  ask: (wrong) => new Promise((resolve) => {
    if (wrong) $("ask-why").textContent = "That is not the token. It stands in the file that the console was started with.";
    $("token").value = "";
    $("ask").addEventListener("close", () => resolve($("token").value), { once: true });
    $("ask").addEventListener("cancel", (event) => event.preventDefault());
    $("ask").showModal();
  }),
});

function turn() {
  const view = location.hash.slice(1) in PARTS ? location.hash.slice(1) : "live";
  for (const name of Object.keys(PARTS)) {
    $(name).hidden = name !== view;
    const anchor = document.querySelector(`nav a[href="#${name}"]`);
    if (name === view) anchor.setAttribute("aria-current", "page");
    else anchor.removeAttribute("aria-current");
  }
  const more = [graph.isWanted && "covisible", obstacles.isWanted && "obstacles"].filter(Boolean);
  link.show(view === "live" ? [...PARTS.live, ...more] : PARTS[view]);
}

addEventListener("hashchange", turn);
turn();
setInterval(() => charts.forEach((chart) => chart.draw()), 250);
