// Views of the page as full as they get: what the stand-in says for each, in the words of the programs that say it.

const BOARD = { columns: 9, rows: 6, square_m: 0.03, lens: "full" };
const CAMERA = { identity: "usb-046d_HD_Pro_Webcam_C920_1234ABCD", device: "/dev/video0" };

/** Corners of a board in a picture of 640x480, row by row. */
const corners = Array.from({ length: BOARD.rows }, (_, row) => Array.from({ length: BOARD.columns }, (_, i) => [180 + 30 * i + 4 * row, 140 + 30 * row - 3 * i]).flat());

const guidance = {
  views: 7, enough: 15, most: 60, grid: [8, 6], cells: Array.from({ length: 48 }, (_, i) => (i % 8 > 1 && i % 5 > 0 ? i : 0)),
  outlines: [[0.2, 0.3, 0.6, 0.25, 0.62, 0.6, 0.22, 0.66], [0.4, 0.2, 0.9, 0.3, 0.85, 0.7, 0.42, 0.6]],
  gauges: [
    ["views", "Views", "7 of 15", 0.47], ["coverage", "Picture covered", "58 % of 70 %", 0.83], ["sideways", "Turned sideways", "31° of 25°", 1],
    ["forward", "Tilted forward", "12° of 25°", 0.48], ["precision", "Precision", "centre ± 0.48 % of 0.30 %", 0.62], ["distance", "Distances", "0.31 m to 0.92 m", null],
  ].map(([name, label, words, share]) => ({ name, label, text: words, share })),
  needs: [
    { name: "left", missing: "no view has corners near the left edge", advice: "bring the board to the left edge of the picture" },
    { name: "forward", missing: "the board was tilted (upper or lower side nearer) by 12 degrees at the most", advice: "tilt the board: its upper or lower side nearer to the camera" },
    { name: "precision", missing: "focal length or principal point are known to 0.48 % only", advice: "more views, tilted, near and filling the picture" },
  ],
  solved: true,
};

/** A calibration as the console tells it. */
export const CALIBRATION = {
  idle: { phase: "idle", run: 0, by: 0, sentence: "", board: null, seconds: 0, limit_s: 300, glance: null, guidance: null, outcome: null, camera: null, saved: null, terminal: "" },
  running: {
    phase: "running", run: 1, by: 0, sentence: "the board moves: hold it still for a moment", board: BOARD, seconds: 42, limit_s: 300,
    glance: { sequence: 3, size: [640, 480], look: "unfit", advice: "the board moves: hold it still for a moment", corners }, guidance, outcome: null, camera: CAMERA,
    saved: null, terminal: "cairn calibrate --camera /dev/video0 --pattern 9x6 --square 0.03",
  },
  done: {
    phase: "done", run: 1, by: 0, sentence: "the time is over", board: BOARD, seconds: 0, limit_s: 300, glance: null, guidance,
    outcome: {
      values: [["fx", 612.34, 0.41, "px"], ["fy", 611.87, 0.42, "px"], ["cx", 318.2, 0.9, "px"], ["cy", 243.1, 0.8, "px"], ["k1", -0.12345, 0.00321, ""], ["k2", 0.04567, 0.01234, ""],
        ["p1", -0.00012, 0.0001, ""], ["p2", 0.00034, 0.0001, ""], ["k3", 0, null, ""]].map(([name, value, sigma, unit]) => ({ name, value, sigma, unit })),
      words: ["residual 0.214 px RMS; 58 % of the picture covered; turned up to 31 degrees sideways, 12 forward",
        "the shutter's readout takes 21.4 +- 1.2 ms, as the moving board shows it",
        "missing: the board was tilted (upper or lower side nearer) by 12 degrees at the most: tilt the board: its upper or lower side nearer to the camera"],
      file: "fx_px = 612.34\n", file_name: "camera-640x480.toml", good: false,
    },
    camera: CAMERA, saved: `kept as /var/lib/cairn/cameras/${CAMERA.identity}_640x480.toml for camera ${CAMERA.identity}, which has it from the next map on`,
    terminal: "cairn calibrate --camera /dev/video0 --pattern 9x6 --square 0.03",
  },
};

export const tellCalibration = (page, told) => page.evaluate((t) => window.stage.calibration(t), told);

const matrix = ["", "", ""].map(() => "-1.23456e-6   4.56789e-5  -1.98765e-2");

/** Lines of `cairn twoview`: a name in 18 characters, and what it says. */
const CHAIN = [
  ["first try", "41 matches, 12 inliers, the matches are no better than chance; once more with tilted views, which show no more: what follows is this try's  (1034.5 ms)"],
  ["corners", "812 and 790 of 2411 and 2388 found by fast at 8 scales  (18.2 ms)"], ["tilted views", "3120 and 3044 corners more  (412.0 ms)"],
  ["attributes", "grey level 31 to 224, 118 in the median; salient degree 0.21 to 0.94, 0.62 in the median; direction of 801"], ["", "grey level 29 to 226, 117 in the median"],
  ["matches", "402 by gradients  (33.1 ms)"], ["guided matches", "61 more along the lines  (2.4 ms)"],
  ["F", "377 inliers of 463, median 0.41 px, 1024 samples, log10 false alarms -431  (44.0 ms)"],
  ["", "x_B^T F x_A = 0 in the pictures' own pixels; degeneracy: a plane holds 201 inliers, the others fix the epipole"], ...matrix.map((row) => ["", row]),
  ["E from F and K", "singular values 1, 0.9931, 2.1e-16, forced to 1, 1, 0"],
  ["  its motions", "P_A 3, P_B 371, P_C 1, P_D 2 votes"], ["", "P_B turned by 4.213 degrees, t = [0.9812 -0.0412 0.1881]"], ["E by five points", "P_A 0, P_B 374, P_C 2, P_D 1 votes"],
  ["judge", "motion, 355 points with enough parallax, runner-up 3 of 374 votes"],
  ["adjustment", "from five points: 377 inliers, 377 points, 0.512 -> 0.398 px RMS in 6 steps  (9.8 ms)"],
  ["second_from_first", "turned by 4.198 +- 0.021 degrees, t = [0.9809 -0.0420 0.1899] +- 0.152 degrees"],
  ["triangulation", "377 points, 3.12 to 48.91 baselines away, 9.80 in the median; the adjustment moved them by 1.2 %"], ["parallax", "5.81 degrees in the median"],
  ["F of the motion", "median 0.40 px; this is the F of twoview.json and of the lines drawn"], ...matrix.map((row) => ["", row]),
  ["outcome", "pose and points from the two pictures  (582 ms)"],
].map(([name, words]) => `${name.padEnd(18)}${words}`).join("\n");

const TAKEN = [["a", 640, 480], ["b", 640, 480]];
const STEPS = [["corners_a", 640, 480], ["corners_b", 640, 480], ["attributes", 1280, 480], ["matches", 1280, 480], ["epipolar", 1280, 480], ["motions", 1280, 960], ["distances", 1280, 480], ["scene", 1000, 800]];

/** Two pictures taken and the chain run on them twice: the runs stand beside each other. */
export async function runChain(page) {
  await page.evaluate(() => { location.hash = "pair"; });
  for (const picture of TAKEN) await page.evaluate((p) => window.stage.picture(...p), picture);
  for (const terminal of ["fast --matcher gradients", "susan-41 --matcher attributes"].map((how) => `cairn twoview a.png b.png --detector ${how} --output two --camera camera.txt --guided`)) {
    await page.locator("#chain button").click();
    await page.evaluate(async ([steps, words, line]) => {
      const { id } = window.stage.sent.findLast((word) => word.chain).chain;
      for (const step of steps) await window.stage.picture(...step);
      window.stage.reply(id, true, words, { terminal: line, chain: true });
    }, [STEPS, CHAIN, terminal]);
  }
  await page.evaluate(() => Promise.all([...document.querySelectorAll("#pair img")].map((image) => image.decode())));
}

/** A camera with three controls, one of each kind, that answers as a daemon does. */
export async function offerControls(page) {
  await page.evaluate(() => {
    const { stage } = window;
    // Unit, lowest, highest, step, default, value, who decides.
    const has = { exposure: ["ms", 0.3, 204.7, 0.1, 15.6, 15.6, "auto"], gain: ["steps", 0, 255, 1, 64, 64, "manual-only"], focus: ["steps", 0, 250, 5, 0, 30, "manual"] };
    stage.controls = has;
    const set = (name, value) => {
      const control = has[name];
      if (stage.refuses === name) return [false, `${name}: the camera refused it: Input/output error`];
      control[6] = value === null ? "auto" : control[6] === "manual-only" ? "manual-only" : "manual";
      if (value !== null) control[5] = value;
      return [true, value === null ? `the camera decides on ${name}, ${control[5]} ${control[0]} now` : `${name} is ${value} ${control[0]}`];
    };
    stage.hears = ({ command }) => {
      const action = command?.action;
      const listed = () => [true, Object.entries(has).map(([name, words]) => [name, ...words].join(" ")).join("\n")];
      const said = { camera_controls: listed, set_camera: () => set(action.control, action.value) }[action?.do]?.();
      if (!said) return;
      setTimeout(() => {
        stage.reply(command.id, ...said);
        stage.answered += 1;
      });
    };
  });
  await page.evaluate(() => { location.hash = "live"; });
  await page.getByRole("button", { name: "What it offers" }).click();
  await page.getByRole("button", { name: "Set focus" }).waitFor();
}

/** Records of a daemon, with fields, and words that are longer than a phone is wide. */
export async function tellLog(page) {
  await page.evaluate(() => window.stage.log([
    { level: "NOTE", message: "The file /var/log/cairn.jsonl." },
    { time: "2026-01-01T00:00:00Z", level: "INFO", message: "running", fields: { state: "TRACKING", camera: "usb-046d_HD_Pro_Webcam_C920_1234ABCD" } },
    { time: "2026-01-01T00:00:01Z", level: "WARN", message: "fault began", fields: { fault: "LOST", advice: "Go back to where the camera has been, or move on and a new map begins." } },
    { time: "2026-01-01T00:00:02Z", level: "ERROR", message: "command not carried out", fields: { reason: "/var/lib/cairn/a/very/long/path/without/a/space/to/break/it/at/map.ply: no space left on device" } },
  ], true));
}
