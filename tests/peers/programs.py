"""Our programs under test, and waiting for what they do. Used by the other scripts here."""

import json
import subprocess
import sys
import time
from collections import Counter


def until(what, seconds, condition):
    end = time.monotonic() + seconds
    while not (found := condition()):
        if time.monotonic() > end:
            sys.exit(f"{what}: not within {seconds} s")
        time.sleep(0.05)
    return found


class Program:
    """One of ours: what it says goes into a file, which is shown if the test fails."""

    all = []

    def __init__(self, name, words, folder, environment=None):
        self.name, self.log = name, folder / f"{name}.log"
        with self.log.open("w") as out:
            self.process = subprocess.Popen([str(w) for w in words], env=environment, stdin=subprocess.DEVNULL, stdout=out, stderr=out)
        Program.all.append(self)

    def said(self):
        """How often it said what."""
        lines = (line for line in self.log.read_text().splitlines() if line.startswith("{") and line.endswith("}"))
        return Counter(json.loads(line).get("message") for line in lines)

    def says(self, message, times, seconds):
        def found():
            if self.process.poll() is not None:
                sys.exit(f"{self.name} has ended with {self.process.returncode}")
            return self.said()[message] >= times

        until(f"{self.name}: {message}", seconds, found)

    def end(self, sent, seconds=20):
        self.process.send_signal(sent)
        return self.process.wait(timeout=seconds)

    @classmethod
    def kill_all(cls):
        for program in cls.all:
            if program.process.poll() is None:
                program.process.kill()
                program.process.wait(timeout=10)

    @classmethod
    def show_all(cls):
        for program in cls.all:
            lines = program.log.read_text(errors="replace").splitlines()
            sys.stderr.write(f"--- {program.name} ({program.process.poll()}), {len(lines)} lines\n")
            sys.stderr.write("".join(f"{line}\n" for line in lines[-60:]))
        sys.stderr.flush()
