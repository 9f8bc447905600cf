// What both tests do with a page.
import { PNG } from "pngjs";

export const PATIENCE_MS = 40_000;
export const troubles = [];
export let passed = 0;

export function check(holds, what) {
  if (!holds) throw new Error(`does not hold: ${what}`);
  passed += 1;
  console.log(`ok  ${what}`);
}

export async function image(locator) {
  return PNG.sync.read(await locator.screenshot());
}

/** Pixels of an element for which `wanted` holds. */
export async function pixels(locator, wanted) {
  const { data } = await image(locator);
  let count = 0;
  for (let i = 0; i < data.length; i += 4) if (wanted(data[i], data[i + 1], data[i + 2])) count += 1;
  return count;
}

/** A page whose errors and requests to other hosts are kept in `troubles`; `prepare` is done with it before it is loaded. */
export async function open(browser, url, options = {}, prepare = async () => {}) {
  const page = await (await browser.newContext(options)).newPage();
  page.setDefaultTimeout(PATIENCE_MS);
  page.on("pageerror", (error) => troubles.push(`${error}`));
  page.on("console", (message) => {
    if (message.type() === "error") troubles.push(message.text());
  });
  page.on("request", (request) => {
    const own = new URL(url).host === new URL(request.url()).host || /^(data|blob):/.test(request.url());
    if (!own) troubles.push(`foreign request ${request.url()}`);
  });
  await prepare(page);
  await page.goto(url);
  return page;
}
