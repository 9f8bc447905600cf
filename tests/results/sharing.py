#!/usr/bin/env python3
"""What recorder and bridge cost the daemon: both come and go beside replays at the camera's pace, some seconds with them, some without.

    tests/results/sharing.py REPLAYS RECORDING CONFIG
    tests/results/sharing.py raw SECONDS        the recorder beside a demo, whose pictures are raw: it makes PNG of them
    tests/results/sharing.py ROUNDS RECORDING CONFIG count      the daemon's instructions instead of its time, a replay each

`cairn`, with the bridge in it, is looked for in PATH. The recording's pictures become JPEG first, as most webcams send them. Whoever hears the bridge
is `cairn fleet --plot`, whose session is the router, too. CONFIG is the replays' configuration: obstacles, which a recorder asks for, want to know the camera's
height. Two replays of the same differ by 10 to 20 % on a machine that is shared; two stretches of one replay, one soon after the other, by far less. So
each stretch is compared with those beside nothing before and after it. Prints Markdown.
"""

import json
import os
import pathlib
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time

sys.dont_write_bytecode = True
import paired  # noqa: E402

WAYS = {"nothing": [], "recorder and bridge": ["recorder", "bridge"]}
QUALITY = 90
# Of a stretch: until who has come is at work, and what is measured then. Before the first one the map begins.
SETTLE_S, STRETCH_S, BEGIN_S = 1.2, 2.4, 8.0


def as_jpeg(recording, folder):
    """The same recording with JPEG pictures."""
    from PIL import Image

    shutil.copytree(recording, folder, ignore=shutil.ignore_patterns("*.png"))
    for path in sorted(pathlib.Path(recording, "rgb").glob("*.png")):
        Image.open(path).convert("L").save(pathlib.Path(folder, "rgb", path.name).with_suffix(".jpg"), quality=QUALITY)
    listed = pathlib.Path(folder, "rgb.txt")
    listed.write_text(listed.read_text().replace(".png", ".jpg"))


def start(words, log):
    with open(log, "a", encoding="utf-8") as said:
        return subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=said, stderr=said)


def end(process, name, log):
    process.send_signal(signal.SIGINT)
    if code := process.wait(60):
        sys.exit(f"{name} ended with {code}: {pathlib.Path(log).read_text()[-2000:]}")


class Folder:
    """Files of this run, and Zenoh's two configurations."""

    def __init__(self, path):
        self.path, self.log = pathlib.Path(path), f"{path}/log"
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        for name, ends in {
            "router": {"mode": "router", "listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]}},
            "peer": {"mode": "peer", "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": -1, "exit_on_failure": False}, "listen": {"endpoints": []}},
        }.items():
            (self.path / f"{name}.json5").write_text(json.dumps(ends | {"scouting": {"multicast": {"enabled": False}}}))

    def record(self):
        (self.path / "run.mcap").unlink(missing_ok=True)
        return start(["cairn", "record", self.path / "run.mcap", "--quiet"], self.log)


def company(way, folder):
    """Those of this way, by name, started."""
    words = {"bridge": ["cairn", "bridge", "--robot", "robot", "--zenoh", folder.path / "peer.json5", "--log", "warn"]}
    return {name: folder.record() if name == "recorder" else start(words[name], folder.log) for name in WAYS[way]}


def counted(way, recording, config, folder):
    """Instructions of one replay beside these."""
    beside = company(way, folder)
    time.sleep(2)
    told = paired.instructions(way, recording, config, folder.log)
    for name, process in beside.items():
        end(process, name, folder.log)
    return told


class Poses:
    """When each pose was published and how long after its picture had come, ns, as a subscriber is told."""

    def __init__(self):
        self.watch = subprocess.Popen(["cairn", "watch", "--json"], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        self.told = []
        self.reader = threading.Thread(target=self.read, daemon=True)
        self.reader.start()

    def read(self):
        for line in self.watch.stdout:
            pose = json.loads(line)
            if pose.get("latency_arrival_ns") is not None:
                self.told.append((pose["published_ns"], pose["latency_arrival_ns"]))

    def between(self, begin, end):
        return [latency for published, latency in self.told if begin <= published < end]

    def close(self):
        self.watch.terminate()
        self.watch.wait(10)
        self.reader.join(10)


def ran_ns(pid):
    """CPU time of all threads of a process, ns."""
    return sum(int(pathlib.Path(task, "schedstat").read_text().split()[0]) for task in pathlib.Path(f"/proc/{pid}/task").iterdir())


def stretch(way, replay, poses, folder):
    """Some seconds of a replay beside these; `None` where it ended meanwhile."""
    beside = company(way, folder)
    time.sleep(SETTLE_S)
    file = folder.path / "run.mcap"
    measure = lambda: (time.monotonic_ns(), ran_ns(replay.pid), {n: ran_ns(p.pid) for n, p in beside.items()}, file.stat().st_size if "recorder" in beside else 0)  # noqa: E731
    try:
        before = measure()
        time.sleep(STRETCH_S)
        after = measure()
    except (FileNotFoundError, ProcessLookupError):
        before = after = None
    for name, process in beside.items():
        end(process, name, folder.log)
    if after is None or replay.poll() is not None:
        return None
    latencies = sorted(poses.between(before[0], after[0]))
    if len(latencies) < 20:
        sys.exit(f"{len(latencies)} poses in {STRETCH_S} s beside {way}")
    took = after[0] - before[0]
    told = {"at": before[0], "cpu_ms": (after[1] - before[1]) / 1e6 / len(latencies), "p50": statistics.median(latencies) / 1e6,
            "p95": latencies[len(latencies) * 95 // 100] / 1e6, **{name: 100 * (after[2][name] - ran) / took for name, ran in before[2].items()}}
    if "recorder" in beside:
        told["mb_min"] = (after[3] - before[3]) / 1e6 * 60e9 / took
    return told


def replay(recording, config, folder, turn):
    """The stretches of a replay: a list of (way, what was measured), and how many frames it dropped."""
    poses = Poses()
    with open(folder.log, "a", encoding="utf-8") as said:
        running = subprocess.Popen(["cairn", "replay", recording, "--config", config, "--json", "--log", "warn"], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                                   stderr=said, text=True)
    time.sleep(BEGIN_S)
    stretches = []
    for n in range(turn, 10_000):
        # One way round, then the other: what drifts weighs as much on both. The next replay begins the other way round, too: each of its stretches
        # shows what the other way was measured on.
        for way in WAYS if n % 2 == 0 else reversed(WAYS):
            told = stretch(way, running, poses, folder)
            if told is None:
                out, _ = running.communicate(timeout=60)
                poses.close()
                if running.returncode:
                    sys.exit(f"the replay ended with {running.returncode}: {pathlib.Path(folder.log).read_text()[-2000:]}")
                return stretches, json.loads(out)["dropped"]
            print(f"{way}: {told}", file=sys.stderr, flush=True)
            stretches.append((way, told))
    raise AssertionError("a recording of days")


def beside_nothing(stretches, i, key):
    """What it would have been beside nothing: between the nearest such stretches before and after; `None` where there is none on one side."""
    plain = [told for way, told in stretches if way == "nothing"]
    at = stretches[i][1]["at"]
    before, after = [p for p in plain if p["at"] < at], [p for p in plain if p["at"] > at]
    if not before or not after:
        return None
    (a, b) = (before[-1], after[0])
    share = (at - a["at"]) / (b["at"] - a["at"])
    return a[key] + share * (b[key] - a[key])


def more(replays, way, key):
    """Shares that it was more than beside nothing, %, ascending."""
    told = []
    for stretches in replays:
        for i, (_, here) in [(i, s) for i, s in enumerate(stretches) if s[0] == way]:
            plain = beside_nothing(stretches, i, key)
            if plain is not None:
                told.append(100 * (here[key] / plain - 1))
    return sorted(told)


def middle(values):
    """The median, and between which values it lies with 95 % whatever the distribution (Hettmansperger and Sheather's ranks without interpolation)."""
    n = len(values)
    k = max(0, int(n / 2 - 1.96 * n ** 0.5 / 2) - 1)
    return f"{statistics.median(values):+.1f} ({values[k]:+.1f} to {values[n - 1 - k]:+.1f})"


def show_stretches(replays, dropped):
    rows = []
    for way in WAYS:
        here = [told for stretches in replays for name, told in stretches if name == way]
        mid = lambda key, form: form.format(statistics.median(t[key] for t in here)) if key in here[0] else "–"  # noqa: E731
        change = lambda key: middle(more(replays, way, key))  # noqa: E731
        rows.append([way, len(here), mid("cpu_ms", "{:.2f}"), change("cpu_ms"), mid("p50", "{:.2f}"), change("p50"), mid("p95", "{:.1f}"), change("p95"),
                     mid("recorder", "{:.1f}"), mid("mb_min", "{:.0f}"), mid("bridge", "{:.1f}")])
    paired.show(["beside it", "stretches", "daemon's CPU ms a frame", "more than beside nothing, %", "latency p50 ms", "more, %", "p95 ms", "more, %",
                 "recorder's CPU, % of a core", "recording, MB a minute", "bridge's CPU, % of a core"], rows)
    print(f"\nMedians over stretches of {STRETCH_S:.1f} s each, {SETTLE_S:.1f} s after who has come; in brackets where that median lies with 95 %. In the row of nothing each "
          f"stretch is compared with its own neighbours of the kind: what a difference looks like where there is none. {dropped} frames were dropped in {len(replays)} "
          "replays. The CPU is that of the whole replay, which also reads and inflates the recording's pictures.")


def raw(seconds, folder):
    """The recorder's CPU and megabytes beside a demo."""
    recorder = folder.record()
    time.sleep(1)
    words = ["cairn", "demo", "--quiet", "--seconds", str(seconds), "--output", folder.path / "demo"]
    demo = start(words, folder.log)
    time.sleep(min(5, seconds / 3))  # it paints its room first
    before, size, began = paired.cpu_s(recorder.pid), (folder.path / "run.mcap").stat().st_size, time.monotonic()
    time.sleep(seconds / 2)
    spent, took = paired.cpu_s(recorder.pid) - before, time.monotonic() - began
    grown = (folder.path / "run.mcap").stat().st_size - size
    demo.wait(60)
    end(recorder, "recorder", folder.log)
    paired.show(["pictures", "recorder's CPU, % of a core", "recording, MB a minute"],
                [["raw, 640 x 480 at 30 Hz, as PNG", f"{100 * spent / took:.1f}", f"{grown / 1e6 * 60 / took:.0f}"]])


def main():
    with tempfile.TemporaryDirectory() as path:
        folder = Folder(path)
        if len(sys.argv) == 3 and sys.argv[1] == "raw" and sys.argv[2].isdigit():
            return raw(int(sys.argv[2]), folder)
        count = sys.argv[4:] == ["count"]
        if len(sys.argv) != 4 + count or not sys.argv[1].isdigit():
            sys.exit(__doc__)
        rounds, recording, config = int(sys.argv[1]), f"{path}/recording", sys.argv[3]
        as_jpeg(sys.argv[2], recording)
        if count:
            recording = f"{path}/slowed"
            paired.slowed(f"{path}/recording", recording)
        words = ["cairn", "fleet", "--json", "--plot", folder.path / "fleet.svg", "--zenoh", folder.path / "router.json5"]
        fleet = start(words, os.devnull)
        try:
            if count:
                runs = paired.rounds(list(WAYS), rounds, lambda way: counted(way, recording, config, folder))
                return paired.show_instructions("beside it", runs, runs["nothing"])
            replays, dropped = [], 0
            for turn in range(rounds):
                stretches, lost = replay(recording, config, folder, turn)
                replays.append(stretches)
                dropped += lost
            if fleet.poll() is not None:
                sys.exit("the fleet, which is the router, has ended")
            show_stretches(replays, dropped)
        finally:
            fleet.terminate()
            fleet.wait(10)


if __name__ == "__main__":
    main()
