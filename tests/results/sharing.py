#!/usr/bin/env python3
"""What recorder and bridge cost the daemon: replays at the camera's pace, each beside none, either or both of them, round by round.

    tests/results/sharing.py ROUNDS RECORDING CONFIG
    tests/results/sharing.py raw SECONDS        the recorder beside a demo, whose pictures are raw: it makes PNG of them
    tests/results/sharing.py ROUNDS RECORDING CONFIG count      the daemon's instructions instead of its time

`cairn`, with the bridge in it, is looked for in PATH. The recording's pictures become JPEG first, as most webcams send them. Whoever hears the bridge
is `cairn fleet --plot`, whose session is the router, too. CONFIG is the replays' configuration: obstacles, which a recorder asks for, want to know the camera's
height. What is compared is compared within its round. Prints Markdown.
"""

import json
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time

sys.dont_write_bytecode = True
import paired  # noqa: E402

WAYS = {"nothing": [], "recorder": ["recorder"], "bridge": ["bridge"], "recorder and bridge": ["recorder", "bridge"]}
QUALITY = 90


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


def replay(way, recording, config, folder, count=False):
    """One replay beside these."""
    words = {"bridge": ["cairn", "bridge", "--robot", "robot", "--zenoh", folder.path / "peer.json5", "--log", "warn"]}
    company = {name: folder.record() if name == "recorder" else start(words[name], folder.log) for name in WAYS[way]}
    time.sleep(2)
    beside = {name: process.pid for name, process in company.items()}
    told = paired.instructions(way, recording, config, folder.log) if count else paired.replay(way, recording, config, folder.log, beside)
    for name, process in company.items():
        end(process, name, folder.log)
    if "recorder" in company and not count:
        told["mb_min"] = (folder.path / "run.mcap").stat().st_size / 1e6 * 60 / told["seconds"]
    return told


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
            runs = paired.rounds(list(WAYS), rounds, lambda way: replay(way, recording, config, folder, count))
            if fleet.poll() is not None:
                sys.exit("the fleet, which is the router, has ended")
        finally:
            fleet.terminate()
            fleet.wait(10)
    base = runs["nothing"]
    if count:
        return paired.show_instructions("beside it", runs, base)
    heads = ["beside it", *paired.DAEMON_HEADS, "recorder's CPU, % of a core", "recording, MB a minute", "bridge's CPU, % of a core"]
    paired.show(heads, [[way, *paired.daemon_columns(runs[way], base), paired.mid("recorder", runs[way], "{:.1f}"), paired.mid("mb_min", runs[way], "{:.0f}"),
                         paired.mid("bridge", runs[way], "{:.1f}")] for way in WAYS])
    paired.tell_spread(base, "Beside nothing")


if __name__ == "__main__":
    main()
