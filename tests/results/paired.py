"""Replays at the camera's pace beside other programs, round by round: what is compared is compared within its round, in an order that moves on with each.

Times wobble by 10 % from one replay to the next on a machine that is shared; instructions do not. So the same replays are counted under valgrind, at a third of
the pace, as it takes that much longer: what comes by the clock and not by the frame (health, a page's video) weighs three times as much there as it does.
"""

import json
import os
import pathlib
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time


def cpu_s(pid):
    fields = pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def replay(way, recording, config, log, beside):
    """What a replay tells of itself. `beside`: process ids by name, of which the share of a core over the replay is told."""
    before, began = {name: cpu_s(pid) for name, pid in beside.items()}, time.monotonic()
    with open(log, "a", encoding="utf-8") as said:
        done = subprocess.run(["cairn", "replay", recording, "--config", config, "--json", "--log", "info"], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said, text=True)
    seconds = time.monotonic() - began
    if done.returncode:
        sys.exit(f"the replay ended with {done.returncode}; see {log}")
    summary = json.loads(done.stdout)
    latency = summary["stages"]["latency"]
    return {
        "way": way, "seconds": seconds, "cpu_ms": summary["cpu_ms_per_frame"], "p50": latency["p50_ms"], "p99": latency["p99_ms"],
        "dropped": summary["dropped"], "frames": summary["frames"],
        **{name: 100 * (cpu_s(pid) - before[name]) / seconds for name, pid in beside.items()},
    }


# Of the camera's time to the recording's when instructions are counted; frames of 30 Hz then come with less than the 0.11 s between them that change what is done.
SLOWED = 3


def slowed(recording, folder):
    """The same recording, its pictures farther apart."""
    shutil.copytree(recording, folder)
    # Wheels tell speeds, which would be others.
    pathlib.Path(folder, "odometry.txt").unlink(missing_ok=True)
    listed = pathlib.Path(folder, "rgb.txt")
    lines, first = [], None
    for line in listed.read_text().splitlines():
        stamp, _, rest = line.partition(" ")
        if line and not line.startswith("#"):
            first = float(stamp) if first is None else first
            line = f"{first + SLOWED * (float(stamp) - first):.6f} {rest}"
        lines.append(line)
    listed.write_text("\n".join(lines) + "\n")


def instructions(way, recording, config, log):
    """Millions of instructions a frame of a replay of what was slowed, in all of its threads."""
    with tempfile.NamedTemporaryFile("r") as counted, open(log, "a", encoding="utf-8") as said:
        words = ["valgrind", "--tool=cachegrind", "--cache-sim=no", "--cachegrind-out-file=/dev/null", f"--log-file={counted.name}"]
        done = subprocess.run([*words, "cairn", "replay", recording, "--config", config, "--json", "--log", "info"], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                              stderr=said, text=True, timeout=1200)
        found = re.search(r"I\s+refs:\s+([\d,]+)", pathlib.Path(counted.name).read_text())
    if done.returncode or not found:
        sys.exit(f"the replay under valgrind ended with {done.returncode}; see {log}")
    summary = json.loads(done.stdout)
    return {"way": way, "minstr": int(found[1].replace(",", "")) / 1e6 / (summary["frames"] - summary["dropped"]), "frames": summary["frames"], "dropped": summary["dropped"]}


def show_instructions(what, runs, base):
    rows = [[way, mid("minstr", told, "{:.2f}"), "–" if told is base else change("minstr", told, base), sum(r["dropped"] for r in told)] for way, told in runs.items()]
    show([what, "daemon's instructions a frame, millions", "more than without, %", "frames dropped"], rows)
    spread = 100 * (max(r["minstr"] for r in base) / min(r["minstr"] for r in base) - 1)
    print(f"\n{len(base)} rounds of {base[0]['frames']} frames at a third of the camera's pace under valgrind. Without, the rounds differ by up to {spread:.1f} %.")


def rounds(ways, count, run):
    """What `run` gives of each way, a list each. The first of all reads the recording into the system's cache, and is not counted."""
    run(ways[0])
    runs = {way: [] for way in ways}
    for n in range(count):
        for way in ways[n % len(ways):] + ways[:n % len(ways)]:
            runs[way].append(run(way))
            print(f"round {n + 1}, {runs[way][-1]}", file=sys.stderr, flush=True)
    return runs


def change(key, runs, base):
    """More than in the runs of the same rounds: the median and the span, %."""
    changes = [100 * (r[key] / b[key] - 1) for r, b in zip(runs, base)]
    return f"{statistics.median(changes):+.1f} ({min(changes):+.1f} to {max(changes):+.1f})"


def mid(key, runs, form):
    """The median; a dash where it is not known."""
    return form.format(statistics.median(r[key] for r in runs)) if runs[0].get(key) is not None else "–"


def daemon_columns(runs, base):
    """Of the daemon: CPU and latency, and how much more than `base`, which may be the same."""
    more = lambda key: "–" if runs is base else change(key, runs, base)  # noqa: E731
    return [mid("cpu_ms", runs, "{:.2f}"), more("cpu_ms"), mid("p50", runs, "{:.2f}"), more("p50"), mid("p99", runs, "{:.1f}"), sum(r["dropped"] for r in runs)]


DAEMON_HEADS = ["daemon's CPU ms a frame", "more than without, %", "latency p50 ms", "more, %", "p99 ms", "frames dropped"]


def show(heads, rows):
    print("| " + " | ".join(heads) + " |\n|---|" + "---:|" * (len(heads) - 1))
    for row in rows:
        print("| " + " | ".join(map(str, row)) + " |")


def tell_spread(base, without):
    spread = lambda key: 100 * (max(r[key] for r in base) / min(r[key] for r in base) - 1)  # noqa: E731
    print(f"\n{len(base)} rounds of {base[0]['frames']} frames. {without} the rounds differ among each other by up to {spread('cpu_ms'):.1f} % (CPU) and "
          f"{spread('p50'):.1f} % (median latency). The CPU is that of the whole replay, which also reads and inflates the recording's pictures.")
