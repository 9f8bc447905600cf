"""kill -9 of anything, in any order, round after round."""

import json
import os
import random
import subprocess
import time

from robot import CAIRN, Failure, as_user, check, now, sh, until


def usage():
    """Files and bytes in /dev/shm and /tmp/iceoryx2."""
    count = size = 0
    for top in ("/dev/shm", "/tmp/iceoryx2"):
        for folder, _, names in os.walk(top):
            for name in names:
                try:
                    size += os.lstat(os.path.join(folder, name)).st_blocks * 512
                    count += 1
                except FileNotFoundError:
                    pass
    return count, size


class Watcher:
    """`cairn watch` of one topic, its lines in a file that grows."""

    def __init__(self, topic, number):
        self.topic, self.path = topic, f"/run/watch-{number}.txt"
        self.process = None
        self.start()

    def start(self):
        with open(self.path, "w", encoding="utf-8") as out:
            self.process = subprocess.Popen([CAIRN, "watch", "--json", *self.topic], stdin=subprocess.DEVNULL, stdout=out,
                                            stderr=subprocess.DEVNULL, **as_user("cairn"))
        self.mark()

    def mark(self):
        self.at = os.path.getsize(self.path)

    def heard(self):
        return os.path.getsize(self.path) > self.at

    def last(self):
        """The last whole line."""
        with open(self.path, "rb") as file:
            file.seek(max(0, os.path.getsize(self.path) - 8192))
            lines = file.read().split(b"\n")[:-1]
        try:
            return json.loads(lines[-1]) if lines else {}
        except ValueError:  # of a longer line than was read
            return {}

    def kill(self):
        self.process.kill()
        self.process.wait(10)


def served(daemon, poses, health):
    """Both planners hear this very daemon."""
    h, p = health.last(), poses.last()
    return h.get("pid") == daemon.process.pid and p.get("run_id") == h["run_id"] and poses.heard() and health.heard()


def rounds(stage):
    count = 200 if stage.full else 12
    seed = 20
    random.seed(seed)
    stage.usb("mjpeg", rate=15)
    daemon = stage.daemon()
    watchers = [Watcher([], 0), Watcher(["--health"], 1), Watcher(["--map"], 2)]
    began = now()
    gaps, sizes = [], []
    try:
        until(lambda: served(daemon, *watchers[:2]), 20, "planners get messages")
        for turn in range(count):
            victims = random.sample(["daemon", 0, 1, 2], random.randint(1, 4))
            for victim in victims:
                if victim == "daemon":
                    daemon.process.kill()
                    daemon.process.wait(10)
                else:
                    watchers[victim].kill()
                time.sleep(random.choice([0, 0, 0.02, 0.1]))
            random.shuffle(victims)
            killed = now()
            for victim in victims:
                if victim == "daemon":
                    daemon.start()
                else:
                    watchers[victim].start()
                time.sleep(random.choice([0, 0, 0.02, 0.1]))
            for watcher in watchers:
                watcher.mark()
            # Sometimes it is killed in the middle of starting.
            if turn % 5 == 4:
                continue
            try:
                until(lambda: served(daemon, *watchers[:2]), 15, f"round {turn} (seed {seed}): planners hear again after {victims}")
            except Failure as failure:
                states = [f"{w.topic}: {'heard' if w.heard() else 'silent'}, {w.process.poll()}" for w in watchers]
                raise Failure(f"{failure}; {states}, daemon {daemon.process.poll()}") from None
            gaps.append(now() - killed)
            for watcher in watchers:
                check(watcher.process.poll() is None, f"round {turn}: planner {watcher.topic} ended with {watcher.process.returncode}")
            sizes.append(usage())
            if turn % 20 == 18:
                print(f"round {turn}: {sizes[-1]}, slowest {max(gaps):.2f} s", flush=True)
    finally:
        for watcher in watchers:
            watcher.kill()
    # What a killed node leaves is swept a minute after; the full form lets that pass.
    time.sleep(65 if stage.full else 2)
    settled = usage()
    early, late = sizes[:max(1, len(sizes) // 4)], sizes[-max(1, len(sizes) // 4):]
    most = lambda part: tuple(max(values) for values in zip(*part))
    daemon.process.kill()
    daemon.process.wait(10)
    daemon.start()
    fresh = Watcher([], 3)
    try:
        until(fresh.heard, 15, "a planner hears the last daemon")
    finally:
        fresh.kill()
    (early_files, early_bytes), (late_files, late_bytes) = most(early), most(late)
    check(settled[0] <= early_files + 10 and late_files <= early_files + 30, f"{settled[0]} files in shared memory at the end, {early_files} at the beginning")
    check(settled[1] <= early_bytes * 1.2 + 1e6, f"{settled[1]} bytes at the end, {early_bytes} at the beginning")
    note = (f"seed {seed}; most files and MB in the first quarter {early_files}, {early_bytes / 1e6:.1f}, in the last {late_files}, "
            f"{late_bytes / 1e6:.1f}, {'a minute' if stage.full else '2 s'} after {settled[0]}, {settled[1] / 1e6:.1f}; planners reconnected by themselves")
    gaps.sort()
    return {"done": f"{count} rounds of kill -9 of daemon and planners, 1 to 4 of them in any order",
            "published": f"poses again after {gaps[len(gaps) // 2]:.2f} s (median)", "recovery_s": gaps[-1], "note": note}


SCENARIOS = {"kill_rounds": rounds}
