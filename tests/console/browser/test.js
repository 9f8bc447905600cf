// The page end to end. Prints a line for each check, and fails with the first that does not hold.
import { existsSync, mkdirSync, readFileSync, unlinkSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { chromium } from "playwright-core";
import { Robot } from "./cairn.js";
import { PATIENCE_MS, check, open, passed, pixels, troubles } from "./page.js";

const pictures = process.argv[2];
mkdirSync(pictures, { recursive: true });
const robot = new Robot();
const robots = [robot];

const frames = (page) => page.locator("#video").getAttribute("data-frames").then(Number);
const number = (page, name) => page.locator("#numbers div", { hasText: name }).locator("dd").first().innerText();
const answer = (page, name) => page.locator(".command", { hasText: name }).locator("output");
const stateIs = (page, text) => page.waitForFunction((t) => document.getElementById("state").textContent === t, text);

async function live(page) {
  await stateIs(page, "tracking");
  check(true, "state is told");
  await page.waitForFunction(() => Number(document.getElementById("video").dataset.frames) > 3);
  const [before, began] = [await frames(page), Date.now()];
  await page.waitForTimeout(3000);
  const rate = (1000 * ((await frames(page)) - before)) / (Date.now() - began);
  check(rate > 3, `video advances, ${rate.toFixed(1)} pictures a second here`);
  const video = page.locator("#video");
  check((await pixels(video, (r, g, b) => Math.abs(r - g) < 8 && Math.abs(g - b) < 8 && r > 20 && r < 235)) > 20_000, "the picture is grey");
  check((await pixels(video, (r, g, b) => g > 150 && g > r + 60 && g > b + 40)) > 100, "matches are drawn in green");
  check((await pixels(video, (r, g, b) => r > 180 && r > g + 80 && r > b + 80)) > 50, "corners are drawn in red");
  await page.waitForFunction(() => Number(document.getElementById("map").dataset.landmarks) > 300);
  const map = page.locator("#map");
  await page.waitForTimeout(500);
  check((await pixels(map, (r, g, b) => b > 100 && b > r + 50)) > 300, "landmarks are drawn in blue");
  check((await pixels(map, (r, g, b) => r > 150 && r > b + 60 && r > g + 60)) > 40, "the way is drawn in red");
  const update = Number(await map.getAttribute("data-update-ms"));
  check(update < 30, `a map message takes ${update} ms of the page's thread`);
  for (const view of ["Top", "Follow", "Orbit"]) {
    await page.getByRole("button", { name: view, exact: true }).click();
    await page.waitForTimeout(400);
    check((await pixels(map, (r, g, b) => b > 100 && b > r + 50)) > 100, `landmarks are seen in the view ${view}`);
  }
  check((await pixels(page.locator("#latency"), (r, g, b) => b > r + 60)) > 20, "latency is drawn");
}

async function graph(page) {
  const map = page.locator("#map");
  const drawn = () => map.getAttribute("data-covisible").then(Number);
  check(!((await drawn()) > 0), "covisibility is drawn on demand only");
  await page.locator("#draw-covisible").check();
  await page.waitForFunction(() => Number(document.getElementById("map").dataset.covisible) > 5);
  await page.waitForTimeout(300);
  const green = (r, g, b) => g > r + 25 && g > b + 25;
  check((await pixels(map, green)) > 60, "covisibility is drawn in green");
  await page.screenshot({ path: join(pictures, "covisible.png") });
  await page.locator("#draw-covisible").uncheck();
  await page.waitForTimeout(300);
  check((await drawn()) === 0 && (await pixels(map, green)) < 20, "and taken away again");
}

async function camera(page) {
  const row = page.locator("#camera .command").first();
  check((await row.locator(".shell").innerText()) === "cairn command --prefix robot camera", "the camera group shows its command");
  await row.getByRole("button").click();
  await page.waitForFunction(() => document.querySelector("#camera output").dataset.ok === "false");
  const said = await row.locator("output").innerText();
  check(/^simulator .* has no exposure, gain or focus that could be set$/.test(said), `a simulated camera says plainly: ${said}`);
  const typed = robot.type(await row.locator(".shell").innerText());
  check(!typed.ok && typed.error.endsWith(said), "and so does its command, typed in a terminal");
  check((await page.locator("#camera .command").count()) === 1, "and there is nothing to set");
}

/** The command of a button, typed in a terminal, does what the button did: `button` and `typed` are what each said. */
function same(line, button, { ok, said, error }) {
  // Numbers are those of another moment.
  const words = (text) => text.replaceAll(/\d+(\.\d+)?/g, "N").trim();
  check(ok && words(said) === words(button), `${line}, typed in a terminal, says as well: ${said || error}`);
}

async function buttons(page) {
  const ply = join(robot.folder, "map.ply");
  const save = page.locator(".command", { hasText: "Save the map" });
  await save.locator("input").fill(ply);
  check((await save.locator(".shell").innerText()) === `cairn command --prefix robot save-map ${ply}`, "a button shows its command");
  await save.getByRole("button").click();
  await page.waitForFunction(() => document.querySelectorAll("output[data-ok=true]").length === 1);
  check(existsSync(ply) && readFileSync(ply, "latin1").startsWith("ply"), "the map is saved where the button says");
  const retype = async (row) => {
    const line = await row.locator(".shell").innerText();
    same(line, await row.locator("output").innerText(), robot.type(line));
  };
  unlinkSync(ply);
  await retype(save);
  check(existsSync(ply), "and the map is saved by it");
  const text = join(robot.folder, "trajectory.txt");
  const trajectory = page.locator(".command", { hasText: "Save the trajectory" });
  await trajectory.locator("input").fill(text);
  await trajectory.getByRole("button").click();
  await page.waitForFunction(() => document.querySelectorAll("output[data-ok=true]").length === 2);
  check(existsSync(text) && readFileSync(text, "utf8").length > 100, "the trajectory is saved");
  unlinkSync(text);
  await retype(trajectory);
  check(existsSync(text), "and the trajectory by its command");
  await trajectory.locator("input").fill("/proc/nowhere/trajectory.txt");
  await trajectory.getByRole("button").click();
  await page.waitForFunction(() => document.querySelector("output[data-ok=false]"));
  check((await answer(page, "Save the trajectory").innerText()).length > 5, "a refusal is told");
  const place = page.locator(".command", { hasText: "The robot is at" });
  const isNear = (x) => page.waitForFunction((near) => Math.abs(Number.parseFloat([...document.querySelectorAll("#numbers div")].find((d) => d.firstChild.textContent === "Position").lastChild.textContent) - near) < 3, x);
  for (const [i, value] of ["50", "0", "0"].entries()) await place.locator("input").nth(i).fill(value);
  await place.getByRole("button").click();
  // Poses that say so may arrive before the answer does.
  await place.locator("output[data-ok=true]").waitFor();
  await isNear(50);
  check(true, "the robot is where it was said to be");
  await place.locator("input").nth(0).fill("-70");
  const line = await place.locator(".shell").innerText();
  same(line, await place.locator("output").innerText(), robot.type(line));
  await isNear(-70);
  check(true, "and where the command says");
  const command = (name) => page.locator(".command").filter({ has: page.getByRole("button", { name, exact: true }) });
  const keep = command("Keep the map");
  await keep.locator("input").fill("room");
  check((await keep.locator(".shell").innerText()) === "cairn map --prefix robot save room", "a button on maps shows its command");
  await keep.getByRole("button").click();
  await page.waitForFunction(() => [...document.querySelectorAll(".command output[data-ok=true]")].some((o) => o.textContent.includes("room.map")));
  // There is one map of a name.
  const kept = (await keep.locator("output").innerText()).replace("room.map", "attic.map");
  await keep.locator("input").fill("attic");
  const again = await keep.locator(".shell").innerText();
  same(again, kept, robot.type(again));
  const load = command("Go on in a map");
  await load.locator("input").focus();
  await page.waitForFunction(() => [...document.querySelectorAll("#stored-maps option")].some((o) => o.value === "room"));
  check(true, "stored maps are listed");
  await load.locator("input").fill("no-such-map");
  await load.getByRole("button").click();
  await page.waitForFunction(() => [...document.querySelectorAll(".command output[data-ok=false]")].some((o) => o.textContent.includes("no-such-map")));
  check(true, "a map that is not there is refused, and the page says so");
  // `other`: there is one map of a name, and one that is present is not loaded.
  for (const [name, value, other] of [["Go on in a map", "room", "attic"], ["Only locate in the map"], ["Let the map grow again"], ["Begin a new map", "other", "third"]]) {
    const row = command(name);
    if (value) await row.locator("input").fill(value);
    await row.getByRole("button").click();
    await page.waitForFunction((n) => [...document.querySelectorAll(".command")].find((c) => [...c.querySelectorAll("button")].some((b) => b.textContent === n)).querySelector("output").dataset.ok === "true", name);
    check(true, `a button does it: ${name}`);
    if (value) await stateIs(page, "tracking");
    const said = await row.locator("output").innerText();
    if (other) await row.locator("input").fill(other);
    const line = await row.locator(".shell").innerText();
    same(line, said.replace(`${value}.map`, `${other}.map`), robot.type(line));
    if (value) await stateIs(page, "tracking");
  }
  const resets = Number(await number(page, "Resets"));
  const drop = page.getByRole("button", { name: "Drop the map" });
  await drop.click();
  await page.getByRole("button", { name: "Really drop it?" }).click();
  await page.waitForFunction((n) => Number([...document.querySelectorAll("#numbers div")].find((d) => d.firstChild.textContent === "Resets").lastChild.textContent) > n, resets);
  await page.waitForFunction(() => [...document.querySelectorAll(".command")].find((c) => c.textContent.includes("Drop the map")).querySelector("output").dataset.ok === "true");
  check(true, "the map is dropped by a second click");
  await stateIs(page, "tracking");
  const [dropped, row] = [Number(await number(page, "Resets")), page.locator(".command", { hasText: "Drop the map" })];
  await retype(row);
  await page.waitForFunction((n) => Number([...document.querySelectorAll("#numbers div")].find((d) => d.firstChild.textContent === "Resets").lastChild.textContent) > n, dropped);
  check(true, "and by its command");
}

async function pair(page) {
  await page.getByRole("link", { name: "Two pictures" }).click();
  const take = async () => {
    for (const which of ["a", "b"]) {
      await page.locator(`#take-${which}`).click();
      await page.waitForFunction((w) => document.getElementById(`picture-${w}`).naturalWidth === 640 && !document.getElementById("take-a").disabled, which);
      await page.waitForTimeout(800);
    }
  };
  await take();
  check(true, "two pictures are taken");
  for (const which of ["a", "b"]) {
    const line = await page.locator(`#shell-${which}`).innerText();
    const typed = robot.type(line);
    check(typed.ok && readFileSync(join(robot.folder, `${which}.png`), "latin1").startsWith("\x89PNG"), `${line}, typed in a terminal, takes one, too: ${typed.said || typed.error}`);
    await page.waitForTimeout(800);
  }
  const run = page.getByRole("button", { name: "Run the chain" });
  const chosen = (id) => page.locator(`#${id} option`).evaluateAll((options) => options.map((o) => o.value));
  const [detectors, matchers] = [await chosen("detector"), await chosen("matcher")];
  check(detectors.length === 4 && matchers.length === 5, `detectors ${detectors}, matchers ${matchers}`);
  // Each of them once.
  const ways = [...detectors.slice(1).map((d) => [d, "gradients"]), ...matchers.slice(1).map((m) => ["fast", m]), ["susan", "attributes"], ["fast", "gradients"]];
  const article = page.locator("#results article").last();
  const runs = async (detector, matcher) => {
    await page.locator("#detector").selectOption(detector);
    await page.locator("#matcher").selectOption(matcher);
    // A result of before is told from the new one.
    await page.evaluate(() => document.querySelector("#results article:last-child")?.setAttribute("data-before", ""));
    await run.click();
    await page.waitForFunction((words) => {
      const last = document.querySelector("#results article:last-child:not([data-before])");
      return last?.querySelector("code").textContent.includes(words) && /Outcome/.test(last.textContent);
    }, `--detector ${detector} --matcher ${matcher} `);
  };
  for (const [detector, matcher] of ways) {
    await runs(detector, matcher);
    check(true, `the chain runs by ${detector} and ${matcher}`);
  }
  check((await page.locator("#results article").count()) === 2, "the run before stays beside the last one");
  const typed = robot.type(await article.locator("code").innerText());
  // Two pictures on a moving robot may be ambiguous, which it says, and its exit code.
  check(/^outcome/m.test(typed.said) && existsSync(join(robot.folder, "two/matches.png")), `the chain's command, typed in a terminal, does it with those: ${typed.said.match(/^outcome +(.*)/m)?.[1] ?? typed.error}`);
  // So may the page's, which are others (the robot turned on the spot, say), and then nothing is triangulated: it takes two new ones, as a person would.
  for (let tries = 0; tries < 8 && !(await article.innerText()).includes("relative pose and points reconstructed"); tries += 1) {
    await take();
    await runs("fast", "gradients");
  }
  // A picture that the page has is not drawn yet.
  await article.evaluate((a) => Promise.all([...a.querySelectorAll("img")].map((image) => image.decode())));
  for (const [step, pictured, says] of [
    ["Corners", 2, /found by fast/], ["Attributes", 1, /salient degree 0\.\d+ to/], ["Matches", 1, /\d+ by gradients/],
    ["Fundamental matrix F", 1, /inliers of/], ["Essential matrix E", 0, /singular values 1, /], ["Four motions and their votes", 1, /P_D turned by.*t = /s],
    ["Triangulation", 1, /baselines away/], ["Adjustment", 0, /px RMS/], ["The scene in 3D", 1, /red the two cameras/], ["Outcome", 0, /./],
  ]) {
    const section = article.locator("section").filter({ has: page.getByRole("heading", { name: step, exact: true }) });
    const drawn = await section.locator("img").evaluateAll((images) => images.map((i) => i.complete && i.naturalWidth > 100));
    const told = await section.innerText();
    if (!says.test(told)) throw new Error(`does not hold: ${step} says ${says}, but: ${told}`);
    check(drawn.length === pictured && drawn.every(Boolean), `the step is shown: ${step}, ${pictured} pictures, numbers, a sentence`);
  }
  await page.screenshot({ path: join(pictures, "pair.png"), fullPage: true });
}

async function log(page) {
  await page.getByRole("link", { name: "Log" }).press("Enter");
  await page.waitForFunction(() => [...document.querySelectorAll("#records li")].some((li) => li.textContent.includes("running")));
  check(true, "the log is shown");
  await page.locator("#log-filter").fill("camera model");
  const rows = page.locator("#records li");
  await page.waitForFunction(() => [...document.querySelectorAll("#records li")].every((li) => li.textContent.includes("camera model")));
  check((await rows.count()) >= 1, "the log is filtered");
  await page.screenshot({ path: join(pictures, "log.png") });
  const every = (wanted) => page.waitForFunction((w) => {
    const all = [...document.querySelectorAll("#records li")];
    return all.length > 0 && all.every((li) => new RegExp(w).test(`${li.dataset.level} ${li.textContent}`));
  }, wanted);
  await page.locator("#log-filter").fill("state=TRACKING");
  await every("state=TRACKING");
  check(true, "by a field and its value, too");
  await page.locator("#log-filter").fill("");
  await page.locator("#log-level").selectOption("1");
  // A note is the console's: which file it is.
  await every("^(WARN|ERROR|NOTE) ");
  check(true, "and by level");
  await page.locator("#log-level").selectOption("2");
  await page.getByRole("link", { name: "Live" }).click();
}

async function killed(page, demo) {
  demo.kill("SIGKILL");
  await page.waitForFunction(() => document.getElementById("banner").textContent.includes("No daemon"));
  check((await page.locator("#state").innerText()) === "no daemon", "a killed daemon is told");
  await page.screenshot({ path: join(pictures, "away.png") });
  robot.demo();
  await stateIs(page, "tracking");
  const before = await frames(page);
  await page.waitForFunction((n) => Number(document.getElementById("video").dataset.frames) > n + 3, before);
  check((await page.locator("#banner").innerText()) === "", "the next daemon is found");
}

async function token(browser) {
  const file = join(robot.folder, "token");
  writeFileSync(file, "a-secret-of-some-length", { mode: 0o600 });
  const { url, child } = await robot.console("--token-file", file);
  const page = await open(browser, url);
  await page.locator("#token").fill("another-secret-of-some");
  await page.getByRole("button", { name: "Open" }).click();
  await page.getByText("That is not the token").waitFor();
  check((await page.locator("#state").innerText()) === "connecting", "a wrong token shows nothing");
  await page.locator("#token").fill("a-secret-of-some-length");
  await page.getByRole("button", { name: "Open" }).click();
  await stateIs(page, "tracking");
  check(!page.url().includes("secret"), "a token opens the page, and stands in no address");
  child.kill("SIGKILL");
  await page.getByText("The console is gone").waitFor();
  check(true, "a console that has gone is told");
}

/** All of one browser, and so of one address. Of the log, as twenty maps are more than software GL draws. */
async function manyPages(context, url) {
  context.setDefaultTimeout(PATIENCE_MS);
  const pages = await Promise.all(Array.from({ length: 20 }, () => context.newPage()));
  await Promise.all(pages.map((page) => page.goto(`${url}#log`)));
  await Promise.all(pages.map((page) => stateIs(page, "tracking")));
  check(true, "twenty pages that are opened at once are all served");
  await Promise.all(pages.map((page) => page.close()));
}

/** A robot that knows its camera's height: what stands around it, and where it has driven. */
async function surroundings(browser) {
  const place = new Robot("floor");
  robots.push(place);
  try {
    const config = join(place.folder, "floor.toml");
    writeFileSync(config, "[scale]\ncamera_height_m = 0.5\ncamera_height_sigma_m = 0.003\n");
    place.demo(120, "--config", config);
    const { url } = await place.console();
    const page = await open(browser, url, { viewport: { width: 1400, height: 1000 } });
    const says = page.locator("#obstacle-count");
    await page.waitForFunction(() => /has no metres|has no pose|floor is not known/.test(document.getElementById("obstacle-count").textContent));
    check(true, `before there are obstacles the page says why: ${await says.innerText()}`);
    await page.waitForFunction(() => Number(document.getElementById("map").dataset.obstacles) > 10 && Number(document.getElementById("map").dataset.free) > 0, null, { timeout: 100_000 });
    await page.waitForTimeout(500);
    check((await pixels(page.locator("#map"), (r, g, b) => r > 100 && r > g + 35 && g > b + 5)) > 40, `what stands around the robot is drawn: ${await says.innerText()}`);
    await page.screenshot({ path: join(pictures, "obstacles.png") });
    for (const [name, options] of [["obstacles-dark", { colorScheme: "dark", viewport: { width: 1400, height: 1000 } }], ["obstacles-phone", { viewport: { width: 390, height: 844 }, deviceScaleFactor: 2 }]]) {
      const other = await open(browser, url, options);
      await other.waitForFunction(() => Number(document.getElementById("map").dataset.obstacles) > 10);
      await other.waitForTimeout(500);
      await other.screenshot({ path: join(pictures, `${name}.png`), fullPage: name.endsWith("phone") });
      await other.context().close();
    }
    await page.context().close();
  } finally {
    place.end();
  }
}

/** Pixels of the map itself, without what is written over it. */
async function drawn(page, wanted) {
  const show = (isShown) => page.evaluate((shown) => { document.getElementById("map-news").hidden = !shown; }, isShown);
  await show(false);
  const count = await pixels(page.locator("#map"), wanted);
  await show(true);
  return count;
}

/** A robot that drives laps, quickly: the page is open when its first loop is closed. */
async function closedLoop(browser) {
  const place = new Robot("loop");
  robots.push(place);
  try {
    const config = join(place.folder, "loop.toml");
    writeFileSync(config, '[simulator]\nscenario = "room_tour"\nwidth = 320\nheight = 240\nrate_hz = 15.0\nspeed = 2.0\nseed = 2\n');
    place.demo(120, "--config", config);
    const { url } = await place.console();
    const page = await open(browser, url, { viewport: { width: 1400, height: 1000 } });
    await page.waitForFunction(() => Number(document.getElementById("map").dataset.landmarks) > 100);
    check((await page.locator("#map").getAttribute("data-ties")) !== "1", "no loop is closed at the start");
    await page.waitForFunction(() => Number(document.getElementById("map").dataset.ties) > 0, null, { timeout: 100_000 });
    await page.waitForTimeout(1000);
    check(/Loop closed: keyframe \d+ shows the place of \d+/.test(await page.locator("#map-news p").last().innerText()), `a loop is told while it happens: ${await page.locator("#map-news p").last().innerText()}`);
    // A second later it was once not drawn yet.
    let violet = 0;
    for (let second = 0; second < 20 && violet <= 20; second++) {
      violet = await drawn(page, (r, g, b) => b > 150 && b > r + 50 && r > g + 40);
      if (violet <= 20) await page.waitForTimeout(1000);
    }
    check(violet > 20, "and drawn in violet");
    check(Number(await number(page, "Loops")) >= 1, "and counted");
    await page.screenshot({ path: join(pictures, "loop.png") });
    await page.context().close();
  } finally {
    place.end();
  }
}

/** A robot whose lens is covered on its way: what it maps behind that is another map, until it sees a place of the first one. */
async function joinedMaps(browser) {
  const place = new Robot("join");
  robots.push(place);
  try {
    const config = join(place.folder, "join.toml");
    // Dark until it is somewhere that the first map does not know; a third of the round later it is back where it began.
    const dark = "[simulator.blackout]\nenabled = true\nstart_s = 8.0\nframes = 120\nperiod_s = 1000.0\n";
    writeFileSync(config, `[simulator]\nscenario = "room_tour"\nwidth = 320\nheight = 240\nrate_hz = 15.0\nspeed = 1.0\nseed = 2\n${dark}`);
    place.demo(120, "--config", config);
    const { url } = await place.console();
    const page = await open(browser, url, { viewport: { width: 1400, height: 1000 } });
    await page.waitForFunction(() => Number(document.getElementById("map").dataset.landmarks) > 100);
    check((await number(page, "Maps kept, joined")).endsWith(", 0"), "no map is joined at the start");
    await stateIs(page, "lost");
    check(true, "a covered lens is told");
    await page.waitForFunction(() => document.querySelector("#map-news .join"), null, { timeout: 60_000 });
    await page.waitForTimeout(1000);
    const told = await page.locator("#map-news .join").last().innerText();
    check(/^Map \d+ joined: keyframe \d+ shows a place of it$/.test(told), `a joined map is told while it happens: ${told}`);
    await page.waitForFunction(() => Number(document.getElementById("map").dataset.ties) > 0);
    check((await drawn(page, (r, g, b) => r > 140 && g < 90 && b > 70 && r > b + 40)) > 10, "and drawn in pink");
    check(Number((await number(page, "Maps kept, joined")).split(", ")[1]) >= 1, "and counted");
    await page.screenshot({ path: join(pictures, "join.png") });
    await page.context().close();
  } finally {
    place.end();
  }
}

/** Guided calibration before the simulator's board, whose camera is known. */
async function calibrate(browser) {
  const place = new Robot("board");
  robots.push(place);
  try {
    place.demo(400, "--board");
    const { url } = await place.console();
    const page = await open(browser, url, { viewport: { width: 1280, height: 900 } });
    const says = (text, time = PATIENCE_MS) => page.waitForFunction((t) => document.getElementById("board-says").textContent.includes(t), text, { timeout: time });
    const press = (name) => page.locator("#board-buttons").getByRole("button", { name, exact: true }).click();
    const fill = (id, value) => page.locator(`#board-${id}`).fill(value);
    await page.getByRole("link", { name: "Calibrate" }).click();
    await page.waitForFunction(() => Number(document.getElementById("board").dataset.frames) > 3);
    await page.screenshot({ path: join(pictures, "calibrate-start.png") });
    await fill("columns", "8");
    await press("Start");
    await says("9x6 inner corners is seen, 8x6 was asked for");
    check(true, "a board of another size is told");
    await press("Cancel");
    await page.locator("#board-columns").waitFor();
    await fill("columns", "9");
    await fill("square", "30");
    const command = "cairn calibrate --camera auto --pattern 9x6 --square 0.03";
    check((await page.locator("#board-shell").innerText()) === command, "the calibration shows its command");
    const printed = place.type(await page.locator("#board-print").innerText());
    check(printed.ok && readFileSync(join(place.folder, "board.svg"), "utf8").includes("<svg"), "and the one that prints the board, which does");
    await press("Start");
    await page.waitForFunction(() => Number(document.getElementById("board").dataset.corners) === 54);
    check((await pixels(page.locator("#board"), (r, g, b) => (g > 180 && b < 120) || (r > 200 && g > 150 && b < 100))) > 100, "the board is drawn over the picture");
    const others = [["dark", { colorScheme: "dark", viewport: { width: 1280, height: 900 } }], ["phone", { viewport: { width: 390, height: 844 }, deviceScaleFactor: 2 }]];
    for (const [name, options] of others) {
      const other = await open(browser, `${url}#calibrate`, options);
      await other.waitForFunction(() => document.querySelectorAll("#board-needs li").length > 0, null, { timeout: 120_000 });
      await other.waitForFunction(() => Number(document.getElementById("board").dataset.frames) > 3);
      check((await other.locator("#board-phase").innerText()).includes("begun on another page"), `another page sees it (${name})`);
      await other.screenshot({ path: join(pictures, `calibrate-${name}.png`), fullPage: name === "phone" });
      const [wide, wanted] = await other.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
      check(wide <= wanted, `nothing of the calibration is wider than the screen (${name})`);
      await other.context().close();
    }
    await page.screenshot({ path: join(pictures, "calibrate-running.png") });
    await says("Calibrated", 320_000);
    await page.screenshot({ path: join(pictures, "calibrate-done.png") });
    const value = (name) => page.locator("#board-values tr", { has: page.locator("th", { hasText: name }) }).locator("td").first().innerText();
    const [focal, truth] = [Number.parseFloat(await value("fx")), 0.82 * 640];
    check(Math.abs(focal / truth - 1) < 0.01, `the focal length is ${focal} px, in truth ${truth.toFixed(1)} px`);
    check((await page.locator("#board-says").getAttribute("data-kind")) === "good", "the views constrain the camera well");
    check((await page.locator("#board-buttons").getByRole("button", { name: "Save" }).count()) === 0, "for the simulator nothing is saved");
    check((await page.locator("#board-words").innerText()).includes("no camera that it could be kept for"), "and the page says why");
    const [download] = await Promise.all([page.waitForEvent("download"), press("Download")]);
    const file = readFileSync(await download.path(), "utf8");
    check(download.suggestedFilename() === "camera-640x480.toml" && Math.abs(Number(file.match(/^fx_px = ([\d.]+)/m)[1]) - focal) < 0.01, "the calibration is downloaded");
    await press("New");
    await says("Press Start");
    check(await page.locator("#board-columns").isVisible(), "another can begin");
    await page.context().close();
  } finally {
    place.end();
  }
}

for (const signal of ["SIGTERM", "SIGINT"]) process.on(signal, () => { robots.forEach((r) => r.end()); process.exit(1); });
const browser = await chromium.launch({ executablePath: "/usr/bin/chromium", args: ["--no-sandbox", "--enable-unsafe-swiftshader"] });
try {
  // It is killed; on a busy machine that is late.
  const demo = robot.demo(600);
  const { url } = await robot.console();
  const page = await open(browser, url, { viewport: { width: 1360, height: 1000 } });
  await live(page);
  await page.evaluate(() => scrollTo(0, 0));
  await page.screenshot({ path: join(pictures, "desktop.png") });
  await graph(page);
  await camera(page);
  await buttons(page);
  await pair(page);
  await log(page);
  await stateIs(page, "tracking");
  for (const [name, options] of [["dark", { colorScheme: "dark", viewport: { width: 1360, height: 1000 } }], ["phone", { viewport: { width: 360, height: 780 }, deviceScaleFactor: 2 }]]) {
    const other = await open(browser, url, options);
    await other.waitForFunction(() => Number(document.getElementById("map").dataset.landmarks) > 100);
    await other.waitForTimeout(1500);
    await other.screenshot({ path: join(pictures, `${name}.png`), fullPage: name === "phone" });
    const [wide, wanted] = await other.evaluate(() => [document.documentElement.scrollWidth, innerWidth]);
    check(wide <= wanted, `nothing is wider than the screen (${name})`);
    await other.context().close();
  }
  const context = await browser.newContext();
  await manyPages(context, url);
  await context.close();
  await stateIs(page, "tracking");
  await killed(page, demo);
  check(troubles.length === 0, `no error and no foreign request ${troubles.join("; ")}`);
  // The browser tells refused connections as errors; here they are meant.
  await token(browser);
  robot.end();
  for (const context of browser.contexts()) await context.close();
  troubles.length = 0;
  await surroundings(browser);
  await closedLoop(browser);
  await joinedMaps(browser);
  await calibrate(browser);
  check(troubles.length === 0, `no error and no foreign request of the calibration ${troubles.join("; ")}`);
  console.log(`${passed} passed, 0 failed`);
} catch (error) {
  console.log(`${error.stack}\n${troubles.join("\n")}\n${passed} passed, 1 failed`);
  process.exitCode = 1;
} finally {
  await browser.close();
  robot.end();
}
