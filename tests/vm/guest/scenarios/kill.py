"""kill -9 of anything, in any order, round after round."""

import collections
import json
import os
import random
import shutil
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


class Planner(Watcher):
    """One of the other clients' planners: a line on stdout for each pose that comes."""

    # Without a daemon they say so once a second; with one there are fifteen poses.
    LINES, WINDOW_S = 4, 0.9

    def __init__(self, name, command, number):
        self.name, self.command = name, command
        super().__init__([name], number)

    def start(self):
        environment = {**os.environ, "PYTHONPATH": "/run/planners", "OPENBLAS_NUM_THREADS": "1"}
        with open(self.path, "w", encoding="utf-8") as out, open(f"{self.path}.err", "w", encoding="utf-8") as errors:
            # C's stdout would otherwise be written every four kilobytes; stdbuf becomes the program, so that it is what is killed.
            self.process = subprocess.Popen(["stdbuf", "-oL", *self.command], stdin=subprocess.DEVNULL, stdout=out, stderr=errors,
                                            env=environment, **as_user("cairn"))
        self.mark()

    def follows(self):
        """Poses come at a rate that only a living daemon gives."""
        with open(self.path, "rb") as file:
            file.seek(self.at)
            lines = file.read().count(b"\n")
        if lines >= self.LINES:
            return True
        if now() - self.marked > self.WINDOW_S:
            self.mark()
        return False

    def mark(self):
        super().mark()
        self.marked = now()

    def wait(self, what, limit_s):
        try:
            until(self.follows, limit_s, f"the planner in {self.name} {what}")
        except Failure as failure:
            with open(f"{self.path}.err", encoding="utf-8") as file:
                raise Failure(f"{failure}; status {self.process.poll()}, {os.path.getsize(self.path)} bytes said; {file.read()[-400:]}") from None


def planners():
    """The C, C++ and Python planners."""
    shutil.copytree("/mnt/stage/planners", "/run/planners", dirs_exist_ok=True)
    sh("python3 -m compileall -q /run/planners")
    return [Planner("C", ["/run/planners/planner-c"], 4), Planner("C++", ["/run/planners/planner-cpp"], 5),
            Planner("Python", ["python3", "/mnt/stage/guest/planner.py"], 6)]


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
    others = planners()
    watchers += others
    gaps, other_gaps, sizes, kills = [], [], [], collections.Counter()
    try:
        until(lambda: served(daemon, *watchers[:2]), 20, "planners get messages")
        for other in others:
            other.wait("gets poses", 30)
        for turn in range(count):
            # Python takes seconds to start on an emulated processor.
            pool = ["daemon", 0, 1, 2, 3, 4] + ([5] if turn % 4 == 3 else [])
            victims = random.sample(pool, random.randint(1, len(pool)))
            kills.update("daemon" if v == "daemon" else others[v - 3].name if v >= 3 else "watch" for v in victims)
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
            # What the daemon before had sent is read by now; from here on it is this one's.
            for other in others:
                other.mark()
            for other in others:
                other.wait(f"follows again in round {turn} (seed {seed}) after {victims}", 20)
            other_gaps.append(now() - killed)
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
    killed = ", ".join(f"{name} {kills[name]}" for name in ["daemon", "watch", *(o.name for o in others)])
    note += f"; kills: {killed}; the planners in C, C++ and Python followed within {max(other_gaps):.2f} s (its own start included)"
    return {"done": f"{count} rounds of kill -9 of daemon and planners in Rust, C, C++ and Python, 1 to 7 of them in any order",
            "published": f"poses again after {gaps[len(gaps) // 2]:.2f} s (median)", "recovery_s": gaps[-1], "note": note}


SCENARIOS = {"kill_rounds": rounds}
