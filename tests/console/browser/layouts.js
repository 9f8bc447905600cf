// Every view at every width, light and dark: labels, the keyboard's way, and nothing that is cut off.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";
import { check } from "./page.js";
import { DESKTOP, PHONE, begin, busy } from "./stand_in.js";
import { CALIBRATION, offerControls, runChain, tellCalibration, tellLog } from "./views.js";

const AXE = readFileSync(createRequire(import.meta.url).resolve("axe-core/axe.min.js"), "utf8");
const WIDTHS = [320, 360, 414, 600, 768, 960, 1024, 1360, 1920, 2560];
const CONTROLS = "a, button, input, select, textarea, summary, [tabindex]:not([tabindex='-1'])";

/** Name of a picture, where it is, and what is told before it is looked at. */
const VIEWS = [
  ["live", "live"],
  ["pair", "pair"],
  ["calibrate", "calibrate", (page) => tellCalibration(page, CALIBRATION.idle)],
  ["calibrate-running", "calibrate", (page) => tellCalibration(page, CALIBRATION.running)],
  ["calibrate-done", "calibrate", (page) => tellCalibration(page, CALIBRATION.done)],
  ["log", "log"],
];

/** A page with all that its views can hold. */
async function full(browser, options) {
  const page = await begin(browser, options);
  await busy(page);
  await offerControls(page);
  await runChain(page);
  await tellLog(page);
  return page;
}

async function turn(page, [, hash, tell]) {
  await page.evaluate((to) => { location.hash = to; }, hash);
  await tell?.(page);
  // The picture of a calibration comes while it is looked at.
  if (tell) await page.evaluate(async () => { for (let i = 1; i < 5; i++) await window.stage.frame(i); });
  await page.waitForTimeout(200);
}

/** What axe finds of WCAG 2.2 A and AA, and its advice. */
export async function labels(page, what) {
  const found = await page.evaluate(async (source) => {
    (0, eval)(source);
    const { violations } = await window.axe.run(document, { resultTypes: ["violations"] });
    return violations.map((v) => `${v.id} (${v.impact}): ${v.nodes.slice(0, 4).map((n) => n.target.join(" ")).join(", ")}`);
  }, AXE);
  check(found.length === 0, `axe finds nothing: ${what} ${found.join("; ")}`);
}

/** Every control of a view is reached by Tab, or back by Shift and Tab, shows it, and is not under the header then. */
async function tabs(page, view, key) {
  await turn(page, view);
  await page.evaluate((controls) => {
    for (const e of document.querySelectorAll("[data-reached]")) delete e.dataset.reached;
    // Tab goes on behind what had the focus last.
    const first = document.querySelector(controls);
    first.focus();
    first.blur();
  }, CONTROLS);
  const reached = new Set();
  // Behind the last control it begins anew, where it has not begun with the first one.
  for (let i = 0, outside = 0; i < 160 && outside < 2; i++) {
    await page.keyboard.press(key);
    const at = await page.evaluate(() => {
      const e = document.activeElement;
      if (e === document.body) return null;
      e.dataset.reached = "yes";
      const header = document.querySelector("header");
      const hidden = !header.contains(e) && e.getBoundingClientRect().bottom <= header.getBoundingClientRect().bottom;
      return { name: e.id || e.textContent || e.title, ring: getComputedStyle(e).outlineStyle !== "none", hidden };
    });
    if (!at) {
      outside += 1;
      continue;
    }
    if (!at.ring) throw new Error(`does not hold: ${at.name} shows that it has the focus (${view[0]})`);
    if (at.hidden) throw new Error(`does not hold: ${at.name} is not under the header when it has the focus (${view[0]})`);
    reached.add(at.name);
  }
  const missed = await page.evaluate((controls) => [...document.querySelectorAll(controls)]
    .filter((e) => e.checkVisibility() && !e.disabled && !e.dataset.reached).map((e) => e.id || e.textContent), CONTROLS);
  check(reached.size > 4 && missed.length === 0, `the keyboard reaches all ${reached.size} controls by ${key}: ${view[0]} ${missed}`);
}

/** The keyboard's way through every view. */
export async function keyboard(browser) {
  for (const [options, key] of [[DESKTOP, "Tab"], [PHONE, "Shift+Tab"]]) {
    const page = await full(browser, options);
    for (const view of VIEWS) await tabs(page, view, key);
    await page.context().close();
  }
}

/** What is wider than the screen, or than the panel that cuts it off. */
const cutOff = (page) => page.evaluate(() => {
  const wide = document.documentElement.scrollWidth > innerWidth ? [`the page is ${document.documentElement.scrollWidth} px wide`] : [];
  const panels = [...document.querySelectorAll(".panel, #results article")].filter((e) => e.checkVisibility());
  const over = panels.filter((e) => e.scrollWidth > e.clientWidth).map((e) => `${e.getAttribute("aria-labelledby") ?? "a result"} is cut off, ${e.scrollWidth} px of ${e.clientWidth}`);
  return [...wide, ...over];
});

export async function layouts(browser, pictures) {
  const schemes = [["desktop", DESKTOP], ["dark", { ...DESKTOP, colorScheme: "dark" }], ["phone", PHONE], ["phone-dark", { ...PHONE, colorScheme: "dark" }]];
  for (const [name, options] of schemes) {
    const page = await full(browser, options);
    for (const view of VIEWS) {
      await turn(page, view);
      await labels(page, `${name}, ${view[0]}`);
      await page.screenshot({ path: join(pictures, `scripted-${name}-${view[0]}.png`), fullPage: view[0] !== "log" });
    }
    await page.context().close();
  }
  const page = await full(browser, DESKTOP);
  for (const view of VIEWS) {
    await turn(page, view);
    for (const width of WIDTHS) {
      await page.setViewportSize({ width, height: 900 });
      const found = await cutOff(page);
      if (found.length > 0) throw new Error(`does not hold: ${view[0]} fits ${width} px: ${found.join("; ")}`);
    }
  }
  check(true, `every view fits ${WIDTHS[0]} to ${WIDTHS.at(-1)} px, and nothing of it is cut off`);
  await page.context().close();
}
