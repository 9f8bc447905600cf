// How long the page takes and what it weighs, beside a running demo. Prints Markdown.
import { chromium } from "playwright-core";
import { Robot } from "./cairn.js";
import { open } from "./page.js";

const TIMES = 7;
const robot = new Robot();
const median = (values) => [...values].sort((a, b) => a - b)[Math.floor(values.length / 2)];
for (const signal of ["SIGTERM", "SIGINT"]) process.on(signal, () => { robot.end(); process.exit(1); });
const browser = await chromium.launch({ executablePath: "/usr/bin/chromium", args: ["--no-sandbox", "--enable-unsafe-swiftshader"] });

/** From asking for the page to its first picture and its first map, ms, and what came on the way. */
async function once(url) {
  const page = await open(browser, url, { viewport: { width: 1360, height: 1000 } });
  await page.waitForFunction(() => Number(document.getElementById("video").dataset.frames) > 0);
  const told = await page.evaluate(() => {
    const [navigation] = performance.getEntriesByType("navigation");
    const parts = [navigation, ...performance.getEntriesByType("resource").filter((r) => r.name.startsWith(location.origin) && !r.name.endsWith("/access"))];
    return { loaded: navigation.loadEventEnd, shown: performance.now(), parts: parts.length, bytes: parts.reduce((sum, p) => sum + p.encodedBodySize, 0) };
  });
  await page.waitForFunction(() => Number(document.getElementById("map").dataset.landmarks) > 300);
  await page.waitForTimeout(1000);
  // Pictures of the screen with video and map at work.
  const rate = await page.evaluate(() => new Promise((resolve) => {
    const [began, end] = [performance.now(), performance.now() + 3000];
    let count = 0;
    const frames = () => Number(document.getElementById("video").dataset.frames);
    const before = frames();
    const next = (now) => {
      count += 1;
      if (now < end) requestAnimationFrame(next);
      else resolve({ rate: (1000 * count) / (now - began), pictures: (1000 * (frames() - before)) / (now - began), update: Number(document.getElementById("map").dataset.updateMs) });
    };
    requestAnimationFrame(next);
  }));
  await page.context().close();
  return { ...told, ...rate };
}

try {
  robot.demo();
  const { url } = await robot.console();
  const found = [];
  for (let i = 0; i < TIMES; i++) found.push(await once(url));
  const row = (name, key, digits, scale = 1) => `| ${name} | ${(median(found.map((f) => f[key])) / scale).toFixed(digits)} |`;
  console.log(["| what | median |", "|---|---:|", row("parts of the page", "parts", 0), row("weight on its way, kB", "bytes", 0, 1000), row("loaded, ms", "loaded", 0),
    row("first picture of the camera, ms", "shown", 0), row("pictures of the screen a second, video and map at work", "rate", 0),
    row("pictures of the camera shown a second, of 20 at most", "pictures", 1), row("main thread, ms a map message", "update", 2)].join("\n"));
} finally {
  await browser.close();
  robot.end();
}
