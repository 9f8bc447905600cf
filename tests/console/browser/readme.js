// The picture of README.md and docs/console.md, .github/console.jpg: a drive in metres with tags on the walls, once its first loop is closed.
// Wants a machine that does nothing else: the page shows how quick the robot is. `run PICTURES readme.js` leaves PICTURES/console.jpg.
import { mkdirSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { chromium } from "playwright-core";
import { Robot } from "./cairn.js";
import { check, open, troubles } from "./page.js";

const pictures = process.argv[2];
const LAP_MS = 240_000;
mkdirSync(pictures, { recursive: true });
const robot = new Robot();
for (const signal of ["SIGTERM", "SIGINT"]) process.on(signal, () => { robot.end(); process.exit(1); });
const browser = await chromium.launch({ executablePath: "/usr/bin/chromium", args: ["--no-sandbox", "--enable-unsafe-swiftshader"] });
try {
  const config = join(robot.folder, "drive.toml");
  writeFileSync(config, "[scale]\ncamera_height_m = 0.5\n\n[tag]\nsize_m = 0.16\n\n[simulator]\nrate_hz = 20.0\n\n[simulator.tags]\nenabled = true\n");
  robot.demo(300, "--config", config);
  const { url } = await robot.console();
  const page = await open(browser, url, { viewport: { width: 1360, height: 1000 } });
  await page.waitForFunction(() => {
    const { ties, tags, obstacles } = document.getElementById("map").dataset;
    return Number(ties) > 0 && Number(tags) >= 3 && Number(obstacles) > 50;
  }, null, { timeout: LAP_MS });
  // The view has gone along with the correction, and the charts have drawn it.
  await page.waitForTimeout(1500);
  await page.screenshot({ path: join(pictures, "console.jpg"), type: "jpeg", quality: 85 });
  check(troubles.length === 0, `no error and no foreign request ${troubles.join("; ")}`);
} catch (error) {
  console.log(`${error.stack}\n${troubles.join("\n")}`);
  process.exitCode = 1;
} finally {
  await browser.close();
  robot.end();
}
