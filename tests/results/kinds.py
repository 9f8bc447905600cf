"""What is measured: for each kind of results its sections, each by one command."""

import dataclasses
import importlib.util
import json
import math
import os
import pathlib
import re
import shlex
import shutil
import statistics
from collections.abc import Callable

ROOT = pathlib.Path(__file__).resolve().parent.parent.parent
OUT = "target/results"


class Missing(Exception):
    """What has to be there before this kind can be measured."""


@dataclasses.dataclass(frozen=True)
class Step:
    """A section of a file. The command runs in the project's folder and prints Markdown, unless `read` makes it of what it left."""

    title: str
    command: str
    note: str = ""
    # What cargo has to build first, so that building is not in the times.
    build: str = ""
    read: Callable[[str], str] | None = None
    # A table is printed even when the exit code is not zero.
    tells_failures: bool = False


@dataclasses.dataclass(frozen=True)
class Kind:
    title: str
    takes: str
    # Of the folder of recordings and whether the short form is wanted.
    steps: Callable[[pathlib.Path, bool], list[Step]]


def table(heads, rows):
    lines = [heads, ["---", *["---:"] * (len(heads) - 1)], *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def need(data, *names):
    for name in names:
        if not (data / name).exists():
            raise Missing(f"{data / name} is not there; CAIRN_DATA names the folder of recordings")


def need_opencv():
    if not importlib.util.find_spec("cv2"):
        raise Missing("no OpenCV in this python3: pip install opencv-python-headless")


def recordings(data):
    """Every recording with ground truth, as the shell writes it."""
    found = sorted(p.parent.name for p in data.glob("*/rgb.txt") if (p.parent / "groundtruth.txt").is_file())
    if not found:
        raise Missing(f"{data} holds no folder with rgb.txt and groundtruth.txt; CAIRN_DATA names the folder of recordings")
    return found


def places(names):
    return " ".join("$CAIRN_DATA/" + shlex.quote(name) for name in names)


def with_config(text, name, command):
    """The command with a configuration file of this text."""
    path = f"{OUT}/{name}.toml"
    return f"mkdir -p {OUT} && printf {shlex.quote(text)} >{path}\n{command} --config {path}"


def sequences(data, short):
    names = recordings(data)
    suite = f"cairn evaluate --suite {places(names[:2] if short else names)}"
    susan = with_config(r'[features]\ndetector = "susan"\n', "susan", f"{suite} --output {OUT}/susan")
    return [
        Step("In lock-step", f"{suite} --output {OUT}/sequences", "Every frame of every recording, one run, nothing chosen.",
             tells_failures=True),
        Step("At the camera's pace", f"{suite} --real-time --output {OUT}/real-time",
             "Pictures come when the recording's clock says so; what is not ready is dropped.", tells_failures=True),
        Step("With the SUSAN detector", susan, "In lock-step.", tells_failures=True),
    ]


def derived(data, short):
    need_opencv()
    names = recordings(data)[:1 if short else None]
    made, output = f"{OUT}/derived", f"{OUT}/derived-suite"
    command = (f"tests/results/derived.py make {made} {places(names)}\ncairn evaluate --suite {made}/* --output {output} >/dev/null || true\n"
               f"tests/results/derived.py table {output}")
    return [
        Step("Recordings made harder", command, "The same recordings with fewer pictures, gaps, other starts, small, dark, blurred, backwards, mirrored, with somebody who walks past; how stands at the "
             "head of `derived.py`. In lock-step, all with the usual configuration; the error is a geometric mean over the recordings that were tracked, "
             "so read it with the coverage. Something that is chosen by one half is judged by the other."),
    ]


def hours(data, short):
    words, known = "DAYS=2 DAY_S=120 " if short else "", "test --locked --release --test places"
    command = f"{words}cargo {known} -- --ignored --nocapture --exact hours::hours"
    return [Step("Four hours in three rooms", command, "Lap after lap of a simulated building at ten pictures a second, in lock-step, the map's file kept as a "
                 "daemon keeps it; every row is another day, with other lamps and a third of the furniture elsewhere, and begins at the first place again. Memory is "
                 "the process's above what the simulator takes. Adjustments and recognitions are in the same thread as the rest.", build=f"{known} --no-run")]


def uncalibrated(data, short):
    names = recordings(data)[:2 if short else None]
    suite = f"cairn evaluate --suite {places(names)}"
    output = f"{OUT}/uncalibrated"
    steps = [Step("Recordings, all from 60 degrees", f"{suite} --output {output}/calibrated\n{suite} --output {output}/without -- --uncalibrated",
                  "Lock-step. Focal lengths as at the end of the run; a recording with two of them (fx, fy) is not compared.",
                  read=lambda _: lenses(data, names, ROOT / output))]
    return steps


def lenses(data, names, output):
    """What replays without a calibration found, beside what the recordings say."""
    rows = []
    for name in names:
        folders = {way: json.loads((output / way / "results.json").read_text()) for way in ("calibrated", "without")}
        ate, coverage = {}, {}
        for way, result in folders.items():
            of = next(s["evaluation"] for s in result["sequences"] if s["name"] == name) or {}
            ate[way] = f"{of['ate_m']['rmse']:.4f}" if of.get("ate_m") else "–"
            coverage[way] = f"{of['coverage_percent']:.1f}" if of else "–"
        lens = json.loads((output / "without" / f"{name}-summary.json").read_text())["intrinsics"]
        text = (data / name / "camera.yaml").read_text()
        fx, fy = (float(re.search(rf"^{key}:\s*([\d.]+)", text, re.MULTILINE)[1]) for key in ("fx", "fy"))
        one = math.sqrt(fx * fy) if abs(fx / fy - 1) < 0.02 else None
        found = math.sqrt(lens["fx_px"] * lens["fy_px"])
        rows.append([name, f"{found:.1f}", f"{one:.1f}" if one else f"{fx:.1f}, {fy:.1f}", f"{100 * abs(found / one - 1):.1f}" if one else "–",
                     f"{100 * lens['focal_sigma']:.1f}", lens["knowledge"].upper(), ate["calibrated"], ate["without"],
                     coverage["calibrated"], coverage["without"]])
    return table(["sequence", "focal length found px", "named by the recording px", "off %", "published sigma %", "said", "calibrated ATE m",
                  "ATE m", "calibrated coverage %", "coverage %"], rows)


def recovery(data, short):
    need_opencv()
    names = recordings(data)

    def of(way):
        return f"tests/results/recovery.py {way} {'11' if short else '11-14'} {places(names[:1] if short else names)}"

    return [
        Step("Frames cut out", of("cut"),
             "5 to 60 frames are missing at seeded places; came back: by ground truth half of the picture was seen before. The columns are "
             "explained at the head of `recovery.py`."),
        Step("Frames blurred", of("blur"),
             "At the same places the frames are there, blurred by what the camera's motion does in 30 ms, or in longer where its median streak "
             "would be below 40 px."),
    ]


def simulator(data, short):
    cases = "cairn evaluate --simulator"
    if short:
        return [Step("Hard cases, short form", f"{cases} --case standing blackout wide_angle --first-seed 101 --seeds 2 --output {OUT}/simulator",
                     tells_failures=True)]
    return [
        Step("Five rooms a case", f"{cases} --first-seed 101 --seeds 5 --output {OUT}/simulator-seeds",
             "Short form, five rooms a case. Noise, lens distortion, a rolling shutter and motion blur unless a case says otherwise. Turning "
             "on the spot and standing from the first frame on must give no pose.", tells_failures=True),
    ]


def twenty(names, first, seeds):
    """Many rooms a case, with progress on stderr."""
    cases = f" --case {' '.join(names)}" if names else ""
    return Step(f"{seeds} rooms a case", f"cairn evaluate --simulator{cases} --first-seed {first} --seeds {seeds} --output {OUT}/simulator-rooms",
                f"Short form, seeds {first} to {first + seeds - 1}: rooms and movements that nothing was chosen on.", tells_failures=True)


def simulator_long(data, short):
    webcams = "test --locked --release --test uncalibrated"
    test = "test --locked --release --test hard_cases"
    if short:
        return [twenty(["standing", "wide_angle"], 201, 2)]
    return [
        twenty([], 201, 20),
        Step("Hard cases, long form", f"cairn evaluate --simulator --long --output {OUT}/simulator-long",
             "Seed 3, up to ten minutes a case.", tells_failures=True),
        Step("Simulated webcams without a calibration", f"cargo {webcams} -- --ignored --nocapture --test-threads 1", build=f"{webcams} --no-run"),
        Step("What the covariance is worth", f"cargo {test} -- --ignored --nocapture --test-threads 1", build=f"{test} --no-run"),
    ]


# Scenario, seed, seconds of the drives through both lenses.
DRIVES = [("hand_held", 3, 12), ("hand_held", 6, 15), ("room_tour", 3, 12), ("room_tour", 5, 30), ("desk_orbit", 3, 20),
          ("fast_rotation", 4, 12), ("corridor", 3, 20), ("square", 3, 25)]


def drives(data, short):
    def suite(folder, simulations):
        lines = [f"rm -rf {OUT}/{folder}"]
        lines += [f"cairn simulate {options} --output {OUT}/{folder}/{name} >&2" for name, options in simulations]
        return "\n".join([*lines, f"cairn evaluate --suite {OUT}/{folder}/* --output {OUT}/{folder}-suite"])

    lenses = [(f"{scenario}-{seed}{ending}", f"--scenario {scenario} --seed {seed} --seconds {seconds}{option}")
              for scenario, seed, seconds in (DRIVES[:1] if short else DRIVES)
              for ending, option in (("", ""), ("-wide", " --with wide_angle"))]
    walks = [(f"seed-{seed}", f"--scenario room_tour --rate 5 --speed 2 --seconds 25 --seed {seed}")
             for seed in range(21, 22 if short else 31)]
    return [
        Step("Ordinary and wide-angle lens", suite("lenses", lenses),
             "The same drives through the ordinary lens (75° across the diagonal) and a fisheye (150°). In lock-step.", tells_failures=True),
        Step("Five frames a second", suite("walks", walks),
             "Walks with large turns between frames. In lock-step.", tells_failures=True),
    ]


def metres(data, short):
    need(data, "visp_rbt")
    test = "test --locked --release --test floor"
    # Nothing was chosen on these seeds.
    seeds = "331" if short else ",".join(map(str, range(331, 351)))
    floor = f"SCENARIOS=room_tour,corridor,square SEEDS={seeds} SECONDS={25 if short else 60} cargo {test} -- --ignored --nocapture scale::table"
    wheels = "test --locked --release --test wheels"
    intervals = f"SEEDS={'331..331' if short else '331..350'} cargo {wheels} -- --ignored --nocapture intervals"
    rooms = "605" if short else ",".join(map(str, range(605, 613)))
    obstacles = f"SEEN_FLOOR=1 SEEDS={rooms} SECONDS=25 cargo {test} -- --ignored --nocapture obstacles::table"
    config = r"[tag]\nsize_m = 0.0945\nsize_sigma_m = 0.0005\n"
    board = "$CAIRN_DATA/visp_rbt"
    replay = with_config(config, "visp_rbt-tags", f"cairn replay --lockstep --quiet --trajectory {OUT}/visp_rbt-metres.txt {board} >&2")
    return [
        Step("By the camera's height", floor,
             "Rooms of the simulator, camera at 0.5 m, told exactly. Way: the chord of the last half metre of the smooth pose, in each metric "
             "frame; sure: `scale_sigma` was below 0.1 all along it.",
             build=f"{test} --no-run", read=heights),
        Step("What the sigma is worth", intervals,
             "Tours of the simulator's rooms, 40 s; what is said of metres is wrong by what its standard deviation says, drawn for each seed: 1 % of the "
             "wheels' radii (which slip in bursts, too), 0.3 mm of the tags' 160, 3 mm of the camera's 500.", build=f"{wheels} --no-run",
             read=rows_of_table),
        Step("Obstacles and free floor", obstacles,
             "Rooms of the simulator, `seen_floor` on, a scan a second, each bearing beside the simulator's own geometry: a distance is reported where it is within 0.2 m or 10 % "
             "of it, a bearing on which nothing stands up to 1.5 m where the floor is said to be free up to 1 m; a free report is right where nothing "
             "stands before its end, but for 5 cm.", build=f"{test} --no-run", read=rows_of_table),
        Step("By tags: a recording with a board of them", f"{replay}\ncairn evaluate --metric {OUT}/visp_rbt-metres.txt {board}/groundtruth.txt",
             "One rigid motion, no scale, between estimate and truth; the edges of the tags as the ground truth has them.", read=tags),
    ]


HEIGHT = re.compile(r"^(\w+) (\d+): ([\d.]+) m, metric after (?:Some\()?([\d.]+|None)")
WAY = re.compile(r"in (\d+) of (\d+) frames, in (\d+) of (\d+) with a sigma below [\d.]+, which are (-?[\d.]+|NaN) % off in the mean")


def heights(text):
    """The floor test's lines, a row a scene."""
    scenes = {}
    for line in text.splitlines():
        if found := HEIGHT.match(line):
            scene = scenes.setdefault(found[1], [])
            scene.append({"metric": found[4] != "None", "off": math.nan, "way": [0] * 4})
        elif found := WAY.search(line):
            scene[-1].update(way=[int(n) for n in found.groups()[:4]], off=float(found[5]))
    if not scenes:
        raise ValueError("the test printed no drive")
    rows = []
    for name, runs in scenes.items():
        offs = [abs(run["off"]) for run in runs if not math.isnan(run["off"])]
        inside, lengths, right, sure = (sum(run["way"][i] for run in runs) for i in range(4))
        rows.append([f"`{name}`", len(runs), sum(run["metric"] for run in runs), len(offs),
                     f"{statistics.median(offs):.2f}, {max(offs):.2f}" if offs else "–",
                     sum(off < 2 for off in offs), f"{inside} of {lengths}", f"{right} of {sure}"])
    return table(["scene", "seeds", "metric", "ever sure", "sure ways off, mean of a drive, % (median, most)", "below 2 %", "way within 1.96 sigma",
                  "where sure"], rows)


def rows_of_table(text):
    """What a test prints around its table left out."""
    return "\n".join(line for line in text.splitlines() if line.startswith("|"))


def tags(text):
    """What the evaluation says of metres."""
    rows = [line.split(None, 2) for line in text.splitlines() if line.startswith("metric ")]
    if not rows:
        raise ValueError("the evaluation says nothing of metres")
    return table(["figure", "visp_rbt"], [[" ".join(row[:2]), row[2]] for row in rows])


PLACES = "test --locked --release --test places"


def ignored(test, name, trials):
    """The table that a test prints, which is ignored without this."""
    return f"TRIALS={trials} cargo {test} -- --ignored --nocapture --test-threads 1 --exact {name}"


def places_known(data, short):
    """Trials of the simulator's rooms and of recordings."""
    return [
        Step("Places of a room", ignored(PLACES, "rooms::table", 4 if short else 100),
             "Rooms of the simulator from seed 501 on, ten trials each, 320 x 240 pixels at 30 Hz, mapped in one lap. Kidnapped: the lens is covered for "
             "0.2 to 1 s, then sees another place of the room; elsewhere at once: it sees it in the next frame. Another day: a new start in the saved map, only to be located, under other light and with a "
             "third of the furniture moved, 90 frames each. Wrong: off by more than 5 % of the mapped way or 10 degrees in any frame.",
             build=f"{PLACES} --no-run", read=rows_of_table),
        Step("Recordings in their own maps", ignored(PLACES, "recordings::own_maps", 8 if short else 160),
             "From shuffled starts, against the poses of the mapping run at its end.", read=rows_of_table),
    ]


def loops(data, short):
    """What looking for loops costs."""
    drive = f"{OUT}/loops-drive"
    make = f"rm -rf {drive}\ncairn simulate --scenario three_rooms --seconds {15 if short else 150} --output {drive} >&2"
    return [
        Step("What they cost a pose", f"{make}\ntests/results/loops.py {1 if short else 3} {drive}",
             "Replays of 60 m through three rooms at the camera's pace, with `[reconstruction] loops` and without, by turns."),
    ]


def long_drives(data, short):
    """Through several rooms of the simulator."""
    return [
        Step("Long drives", ignored(PLACES, "rooms::drives", 4 if short else 100),
             "A room each. Carried: one of three rooms is mapped, the lens is covered, and the robot drives on from somewhere on the way back through the others. "
             "Alike: 60 m through three rooms that are the same but for three things each. A loop is wrong that ties places more than 3 m apart.",
             build=f"{PLACES} --no-run", read=rows_of_table),
    ]


def store(data, short):
    """`kill -9` of what writes a map."""
    maps = "test --locked --release --test maps"
    return [Step("Killed while it writes", ignored(maps, "kills", 6 if short else 200), build=f"{maps} --no-run", read=rows_of_table)]


def wire(data, short):
    bench = "bench --locked --bench wire"
    return [Step("Between processes", f"cargo {bench}{' -- maps' if short else ''}", build=f"{bench} --no-run")]


def calibration(data, short):
    need(data, "calib_opencv_left", "calib_camodocal")
    need_opencv()
    peer = "test --locked --release --test calibration_peer"
    seeds = "test --locked --lib plane_calibration::"
    return [
        Step("Beside OpenCV", f"cargo {peer} -- --nocapture --test-threads 1",
             "The same pictures in the same run, one thread, the shortest time of three.", build=f"{peer} --no-run"),
        Step("Seeded sets", f"cargo {seeds} -- --nocapture --test-threads 1", build=f"{seeds} --no-run"),
        Step("Pictures through a wide-angle lens, beside OpenCV", SWEEP.format(out=f"{OUT}/sweep"),
             "50 rendered pictures, `findChessboardCorners`, `cornerSubPix` and `fisheye.calibrate` beside our detector and solver.",
             read=lambda _: beside_opencv(ROOT / OUT / "sweep")),
    ]


SWEEP = """rm -rf {out}
cairn simulate --scenario calibration_sweep --with wide_angle --without rolling_shutter,motion_blur --rate 1 --seconds 50 --output {out}
cairn calibrate {out}/rgb/*.png --square 0.03 --distortion fisheye --output {out}/found.toml --no-report
python3 tests/peers/opencv_chessboard.py {out}/rgb 9x6 png >{out}/corners.txt
awk '/^picture/ {{print "view"; i = 0}} /^c / {{print "c", i % 9, int(i / 9), $2, $3; i++}}' {out}/corners.txt \\
    | python3 tests/peers/opencv_fisheye.py 640x480 >{out}/opencv.txt"""


def numbers(path):
    """Keys and numbers of a calibration, ours or a recording's, without their unit px."""
    found = re.findall(r"^(\w+?)(?:_px)?\s*[:=]\s*(-?[\d.eE+-]+)\s*(?:#.*)?$", path.read_text(), re.MULTILINE)
    return {key: float(value) for key, value in found}


def beside_opencv(folder):
    ours, truth = numbers(folder / "found.toml"), numbers(folder / "camera.yaml")
    peer = [float(n) for n in re.search(r"^result (.*)", (folder / "opencv.txt").read_text(), re.MULTILINE)[1].split()]
    seen = len(re.findall(r"^picture ", (folder / "corners.txt").read_text(), re.MULTILINE))
    return table(["by", "pictures with the board", "fx px", "its sigma px", "residual px"], [
        ["Cairn", f"{ours['views']:.0f}", f"{ours['fx']:.2f}", f"{ours['fx_sigma']:.2f}", f"{ours['rms']:.3f}"],
        ["OpenCV", seen, f"{peer[1]:.2f}", "–", f"{peer[0]:.3f}"],
        ["truth", 50, f"{truth['fx']:.2f}", "–", "–"],
    ])


def calibration_live(data, short):
    wide = r"[simulator.lens.wide_angle]\nenabled = true\n"
    return [live_step("Usual lens", "live", "", "full", 1 if short else 16),
            live_step("Wide-angle lens", "live-wide", wide, "fisheye", 1 if short else 4)]


def live_step(title, name, more, distortion, count):
    folder = f"{OUT}/{name}"
    option = " --with wide_angle" if more else ""
    text = shlex.quote(r"[simulator]\nseed = %s\n" + more)
    command = f"""rm -rf {folder}
cairn simulate --scenario calibration_sweep --seconds 0.1{option} --output {folder}/truth
for seed in $(seq {count}); do
    printf {text} "$seed" >{folder}/config.toml
    cairn calibrate --camera simulator --lockstep --square 0.03 --distortion {distortion} --config {folder}/config.toml \\
        --output "{folder}/$seed.toml" --no-report
done"""
    note = "Simulated webcams whose shutter takes 20 ms and which never stand still; each calibration ends by itself."
    return Step(title, command, note, read=lambda _: honesty(ROOT / folder, count))


def honesty(folder, count):
    """Errors of live calibrations against the simulator's camera, and in their own standard deviations."""
    truth = numbers(folder / "truth" / "camera.yaml")
    rows, off, shares = [], [], []
    for seed in range(1, count + 1):
        found = numbers(folder / f"{seed}.toml")
        own = [(found[key] - truth[key]) / found[f"{key}_sigma"] for key in ("fx", "fy", "cx", "cy")]
        share = 100 * (found["fx"] / truth["fx"] - 1)
        off, shares = [*off, *own], [*shares, share]
        rows.append([f"seed {seed}", f"{found['views']:.0f}", f"{found['fx']:.2f}", f"{found['fx_sigma']:.2f}", f"{share:+.3f}",
                     f"{max(map(abs, own)):.1f}", f"{found['rms']:.3f}"])
    rms = lambda values: math.sqrt(statistics.fmean(v * v for v in values))  # noqa: E731
    within = 100 * sum(abs(v) <= 1 for v in off) / len(off)
    return "\n\n".join([
        table(["calibration", "views", "fx px", "its sigma px", "fx off %", "largest error of fx fy cx cy, sigmas", "residual px"], rows),
        table([f"all {count}", "value"], [["true fx px", f"{truth['fx']:.2f}"], ["fx off, RMS %", f"{rms(shares):.3f}"],
                                          ["of fx fy cx cy within one sigma %", f"{within:.0f}"],
                                          ["RMS of their errors, sigmas", f"{rms(off):.2f}"],
                                          ["largest, sigmas", f"{max(map(abs, off)):.1f}"]]),
    ])


# Recordings whose frames half a second and a second apart still see the same.
PAIRED = ["tum_fr1_xyz", "uzh_parking", "new_tsukuba"]


def two_pictures(data, short):
    two_view = [f"two_view/{name}" for name in ("fundamental", "oxford_graf", "scannet_pairs", "motorcycle")]
    need(data, *PAIRED, *two_view)
    need_opencv()
    fundamental, graf, scannet, motorcycle = map(lambda name: places([name]), two_view)
    few = "--detectors fast,susan --matchers descriptors,gradients"

    def compare(folder, paths, options=""):
        """Both tables: of the ways, and of each pair."""
        output = f"{OUT}/compare/{folder}"
        return f"cairn compare {paths} {options + ' ' if options else ''}--output {output} >/dev/null && cat {output}/compare.md"

    def opencv(paths, options):
        return f"python3 tests/peers/opencv_two_view.py {paths} {options}"

    steps = []
    for step in (15, 30):
        steps.append(Step(f"{step} frames apart", f"cairn compare {places(PAIRED)} --step {step} --views none --output {OUT}/compare/{step}",
                          "Ten pairs a recording, all ways, without simulated views."))
        for rule, words in (("ratio", "ratio test"), ("cross", "cross-check")):
            last = " | sed -n '/^| way/,$p'"
            steps.append(Step(f"{step} frames apart, OpenCV with {words}", opencv(places(PAIRED), f"--step {step} --rule {rule}{last}"),
                              "ORB, `findEssentialMat`."))
    annotated = Step("Annotated points", compare("annotated", fundamental, few), "F against points that a person marked.")
    if short:
        return [annotated]
    return [
        *steps,
        annotated,
        Step("A plane seen from three sides", compare("graf", graf, "--views none"), "Repeatability and matches under the true homographies."),
        Step("A plane seen from three sides, with simulated views", compare("graf-affine", graf, f"--views affine {few}")),
        Step("Wide baselines", compare("scannet", scannet, few), "Phone pairs of ScanNet."),
        Step("Wide baselines, made to answer", compare("scannet-answer", scannet, f"--always-answer {few}")),
        Step("Wide baselines, OpenCV with ratio test", opencv(f"{scannet}/pairs_with_gt.txt", "--rule ratio"), "ORB, `findEssentialMat`."),
        Step("Wide baselines, OpenCV with cross-check", opencv(f"{scannet}/pairs_with_gt.txt", "--rule cross"), "ORB, `findEssentialMat`."),
        Step("A rectified pair without its cameras", compare("motorcycle", motorcycle, few), "Epipolar lines should be rows."),
        Step("A rectified pair, matched again along its lines", compare("motorcycle-guided", motorcycle, f"--guided {few}")),
    ]


def fleet(data, short):
    features = "--no-default-features --features bridge --bench fleet"
    return [Step("Many robots on one Zenoh router", f"cargo bench --locked {features}" + (" -- 10 5" if short else ""),
                 "Every robot is a bridge, a process of its own, that hears poses in shared memory; all on this machine.",
                 build=f"bench --locked --no-run {features}")]


def drive_of(name, seconds):
    """The commands that make a drive, and its folder; beside it lies a configuration that knows the camera's height."""
    drive = f"{OUT}/{name}-drive"
    simulate = f"cairn simulate --scenario room_tour --seconds {seconds} --output {drive} >&2"
    height = f"printf '[scale]\\ncamera_height_m = 0.5\\ncamera_height_sigma_m = 0.003\\n' >{drive}.toml"
    return f"rm -rf {drive}\n{simulate}\n{height}", drive


def needs_valgrind():
    if not shutil.which("valgrind"):
        raise Missing("no valgrind, which counts instructions: apt-get install valgrind")


def sharing(data, short):
    if not importlib.util.find_spec("PIL"):
        raise Missing("no Pillow in this python3, which makes the recording's pictures JPEG: pip install pillow")
    needs_valgrind()
    make, drive = drive_of("sharing", 60 if short else 240)
    make_short, counted = drive_of("sharing-short", 8)
    rounds = 1 if short else 2
    return [
        Step("Time", f"{make}\nprintf '' >{drive}-unscaled.toml\ntests/results/sharing.py {rounds} {drive} {drive}-unscaled.toml",
             "Replays of a simulated drive at the camera's pace, its pictures as JPEG. Nobody has told the camera's height: there is no scale, and so there are "
             "neither scans of obstacles nor transforms. `cairn fleet --plot` hears the bridge. All share the machine.",
             build="build --locked --release --features bridge"),
        Step("Instructions", f"{make_short}\ntests/results/sharing.py {3 * rounds} {counted} {drive}-unscaled.toml count", "Of whole replays of a shorter drive."),
        Step("A recorder of raw pictures", f"tests/results/sharing.py raw {15 if short else 60}", "Beside a demo."),
    ]


def console(data, short):
    needs_valgrind()
    make, drive = drive_of("console", 8 if short else 20)
    return [
        Step("What pages cost the daemon", f"{make}\ntests/results/console.py {1 if short else 5} {drive} {drive}.toml",
             "Replays of a simulated drive at the camera's pace, with scripted pages that show video, map and log, and one that shows obstacles, too; what "
             "bad pages do stands at the head of `console.py`. Pages, console and daemon share the machine."),
        Step("In instructions", f"tests/results/console.py {1 if short else 3} {drive} {drive}.toml count",
             "The same: times differ by more from one replay to the next than what is sought."),
        Step("The page in a browser", f"tests/console/browser/run {OUT}/console load.js",
             "Headless Chromium with software GL beside a running demo, each time with an empty cache."),
    ]


def faults(data, short):
    if os.geteuid():
        raise Missing("the guest's image needs root")
    if not short and not shutil.which("cargo-deb"):
        raise Missing("no cargo-deb, which builds the package that is tried: cargo install --locked cargo-deb")
    return [Step("Scenarios", f"tests/vm/run {'--short' if short else '--full'}", tells_failures=True,
                 build="rustc --locked --release --lib --crate-type cdylib --features c")]


def builds(data, short):
    return [Step("Feature sets", "tests/results/builds.sh")]


KINDS = {
    "sequences": Kind("Recorded sequences", "4 min", sequences),
    "derived": Kind("Recordings made harder", "12 min", derived),
    "recovery": Kind("Lost, and found again", "10 min", recovery),
    "simulator": Kind("Hard cases in the simulator", "6 min", simulator),
    "simulator_long": Kind("Hard cases in the simulator, long form", "3 h", simulator_long),
    "drives": Kind("Simulated drives", "5 min", drives),
    "places": Kind("Places known again", "5 min", places_known),
    "loops": Kind("What loops cost", "20 min", loops),
    "long_drives": Kind("Drives through three rooms", "30 min", long_drives),
    "store": Kind("A map's file", "2 min", store),
    "hours": Kind("Hours in one building", "30 min", hours),
    "metres": Kind("Metres", "30 min", metres),
    "uncalibrated": Kind("Without a calibration", "2 min", uncalibrated),
    "calibration": Kind("Calibration", "3 min", calibration),
    "calibration_live": Kind("Live calibration", "15 min", calibration_live),
    "two_pictures": Kind("Two pictures", "10 min", two_pictures),
    "wire": Kind("The wire", "2 min", wire),
    "fleet": Kind("A fleet", "3 min", fleet),
    "sharing": Kind("Recorder and bridge", "25 min", sharing),
    "console": Kind("The console", "15 min", console),
    "faults": Kind("Faults on real device nodes", "40 min", faults),
    "builds": Kind("Builds", "25 min", builds),
}
