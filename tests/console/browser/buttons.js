// Buttons that a simulated robot cannot answer, against the stand-in: what each sends, and what the page makes of the answer.
import { isDeepStrictEqual } from "node:util";
import { join } from "node:path";
import { check } from "./page.js";
import { text } from "./stand_in.js";
import { CALIBRATION, offerControls, tellCalibration } from "./views.js";

/** The last word of this kind that the page said. */
const last = (page, kind) => page.evaluate((k) => window.stage.sent.findLast((word) => word[k])?.[k], kind);
const count = (page, kind) => page.evaluate((k) => window.stage.sent.filter((word) => word[k]).length, kind);

function same(found, wanted, what) {
  check(isDeepStrictEqual(found, wanted), `${what}: ${JSON.stringify(found)}`);
}

/** Exposure, gain and focus of a camera that has them. */
export async function cameraControls(page, pictures) {
  await page.evaluate(() => window.stage.state("connected", "Tracking.", window.stage.daemon()));
  await offerControls(page);
  same((await last(page, "command")).action, { do: "camera_controls" }, "the page asks what the camera offers");
  const row = (name) => page.locator("#camera .command").filter({ has: page.getByRole("button", { name: `Set ${name}`, exact: true }) });
  const [number, auto, says] = [(name) => row(name).getByRole("spinbutton"), (name) => row(name).getByRole("checkbox"), (name) => row(name).locator("output").innerText()];
  const shown = (name) => number(name).evaluate((input) => [input.value, input.min, input.max, input.step, input.disabled]);
  same(await shown("exposure"), ["15.6", "0.3", "204.7", "0.1", true], "a control is shown as the camera has it");
  check((await auto("exposure").isChecked()) && !(await auto("focus").isChecked()) && !(await auto("gain").isVisible()), "and who decides on it; what has no automatic offers none");
  const set = async (name, value, line, words) => {
    if (value === null) await auto(name).check();
    else {
      if (await auto(name).isVisible()) await auto(name).uncheck();
      await number(name).fill(`${value}`);
    }
    check((await row(name).locator(".shell").innerText()) === line, `its command: ${line}`);
    await page.evaluate(() => { window.stage.sent.length = window.stage.answered = 0; });
    await row(name).getByRole("button").click();
    // It asks for all of them again, as one may have changed others.
    await page.waitForFunction(() => window.stage.answered === 2);
    const said = await page.evaluate(() => window.stage.sent.filter((word) => word.command).map(({ command }) => command));
    same(said.map(({ action }) => action), [{ do: "set_camera", control: name, value }, { do: "camera_controls" }], "the page sends");
    check(said[1].id > said[0].id && (await says(name)) === words && (await row(name).locator("output").getAttribute("data-ok")) === "true", `and shows the answer: ${words}`);
  };
  await set("exposure", 8.5, "cairn command camera exposure 8.5", "exposure is 8.5 ms");
  await set("exposure", null, "cairn command camera exposure auto", "the camera decides on exposure, 8.5 ms now");
  check(await number("exposure").isDisabled(), "what the camera decides on is not typed");
  await set("gain", 100, "cairn command camera gain 100", "gain is 100 steps");
  await set("focus", 35, "cairn command camera focus 35", "focus is 35 steps");
  await set("focus", null, "cairn command camera focus auto", "the camera decides on focus, 35 steps now");
  await set("focus", 40, "cairn command camera focus 40", "focus is 40 steps");
  const before = await count(page, "command");
  for (const value of ["999", "33", ""]) {
    await number("focus").fill(value);
    await row("focus").getByRole("button").click();
  }
  check((await count(page, "command")) === before && (await number("focus").evaluate((input) => !input.validity.valid)), "what the camera does not take is not sent");
  await page.evaluate(() => { window.stage.refuses = "focus"; });
  await number("focus").fill("45");
  await row("focus").getByRole("button").click();
  await page.waitForFunction(() => document.querySelector("#camera output[data-ok=false]"));
  check((await says("focus")) === "focus: the camera refused it: Input/output error", "what the camera refuses is told");
  await page.screenshot({ path: join(pictures, "scripted-controls.png"), fullPage: true });
  await page.evaluate(() => window.stage.state("connected", "Tracking.", window.stage.daemon({ run_id: "2" })));
  check((await page.locator("#camera .command").count()) === 1, "another daemon's camera is asked anew");
  await page.evaluate(() => { window.stage.hears = null; });
}

/** Start, Restart, Finish, Save and New of a calibration. */
export async function calibrationOrders(page) {
  const button = (name) => page.locator("#board-buttons").getByRole("button", { name, exact: true });
  const orders = () => page.evaluate(() => window.stage.sent.filter((word) => word.calibrate).map((word) => word.calibrate));
  /** Pressed, it sends these actions, and waits for the answer. */
  const press = async (name, ...actions) => {
    await page.evaluate(() => { window.stage.sent.length = 0; });
    await button(name).click();
    const said = await orders();
    same(said.map(({ action }) => action), actions, `${name} sends`);
    check((await page.locator("#board-buttons button:enabled").count()) === 0, "and waits for the answer");
    return said.map(({ id }) => id);
  };
  const answer = (id, ok = true, words = "done") => page.evaluate((reply) => window.stage.reply(...reply), [id, ok, words]);
  const { idle, running, done } = CALIBRATION;
  const start = { do: "start", board: running.board };
  await page.evaluate(() => { location.hash = "calibrate"; });
  await tellCalibration(page, idle);
  await page.locator("#board-square").fill("30");
  const [begun] = await press("Start", start);
  await answer(begun);
  await tellCalibration(page, { ...running, by: begun, guidance: { ...running.guidance, solved: false } });
  check(await button("Finish").isDisabled(), "without a camera there is nothing to finish with");
  check(!(await text(page, "board-phase")).includes("another page"), "a page knows the calibration that it began");
  await tellCalibration(page, { ...running, by: begun });
  const [dropped, again] = await press("Restart", { do: "cancel" }, start);
  await answer(dropped);
  await tellCalibration(page, { ...idle, run: 1 });
  await answer(again);
  await tellCalibration(page, { ...running, run: 2, by: again });
  check(again > dropped && !(await text(page, "board-phase")).includes("another page") && (await button("Restart").isEnabled()), "Restart begins one of the same board, and it is this page's");
  const [finished] = await press("Finish", { do: "finish" });
  await answer(finished);
  await tellCalibration(page, { ...done, run: 2, by: again, saved: null });
  check((await text(page, "board-says")).startsWith("Calibrated from 7 views"), "Finish ends it with what there is");
  const [full] = await press("Save", { do: "save" });
  await answer(full, false, "/var/lib/cairn/cameras: no space left on device");
  check((await text(page, "board-answer")).includes("no space left") && (await button("Save").isEnabled()), "a calibration that is not saved is told, and can be saved again");
  const [saved] = await press("Save", { do: "save" });
  await answer(saved);
  await tellCalibration(page, { ...done, run: 2, by: again });
  check((await button("Save").count()) === 0 && (await text(page, "board-answer")) === "" && (await text(page, "board-words")).includes("Kept as /var/lib"), "Save says where it is kept");
  const [put] = await press("New", { do: "cancel" });
  await answer(put);
  await tellCalibration(page, { ...idle, run: 2 });
  check(await button("Start").isEnabled(), "New puts it away, and another can begin");
}

/** Whoever sees no record of the log is told where they come from. */
export async function emptyLog(page, pictures) {
  await page.evaluate(() => { location.hash = "log"; });
  const note = { level: "NOTE", message: "The journal of the unit cairn, as far as this user may read it. A daemon that runs in a terminal is not in it: write its log to a file (cairn demo --log info 2>FILE) and start the console with --log-file FILE to see it here." };
  const tell = (records, replace = false) => page.evaluate((told) => window.stage.log(...told), [records, replace]);
  const rows = async () => (await page.locator("#records li").allInnerTexts()).map((words) => words.replaceAll(/\s+/g, " ").trim());
  await tell([note], true);
  same(await rows(), [`NOTE ${note.message}`, "No record so far."], "a log without records says where they would come from");
  await page.screenshot({ path: join(pictures, "scripted-log-empty.png") });
  await tell([{ level: "INFO", message: "running", fields: { state: "TRACKING" } }]);
  same(await rows(), [`NOTE ${note.message}`, "INFO running state=TRACKING"], "records follow it");
  await page.locator("#log-filter").fill("state=LOST");
  same(await rows(), [`NOTE ${note.message}`, "No record passes the filter."], "and so does a filter that none passes");
  await tell([{ level: "WARN", message: "fault began", fields: { state: "LOST" } }]);
  check((await rows()).length === 1 && (await rows())[0].startsWith("WARN fault began"), "until one does");
  await page.locator("#log-filter").fill("");
}
