#!/usr/bin/env python3
"""What the console costs the daemon: replays at the camera's pace, each with other pages connected, round by round.

    tests/results/console.py ROUNDS RECORDING CONFIG
    tests/results/console.py ROUNDS RECORDING CONFIG count      the daemon's instructions instead of its time

A round is a replay with none, 1, 20 and 20 bad pages, and with one that shows obstacles, too, in an order that moves on with each round; `cairn`
is looked for in PATH. CONFIG is the replays' configuration: obstacles want to know the camera's height. A page shows video, map and log and
says what it has seen, as the real one does; obstacles the daemon works out only while somebody asks for them, page or planner. Bad pages: of 20 eight behave, four never read, four read
20 kB/s, and four break a rule each and come again: too many messages, no message at all, too large a message, too large a request.
What is compared is compared within its round. Prints Markdown.
"""

import base64
import json
import os
import pathlib
import re
import selectors
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time

sys.dont_write_bytecode = True
import paired  # noqa: E402

FRAME, MAP = 5, 4
WAYS = ["0", "1", "20", "20, most of them bad", "1, with obstacles"]
# Bytes a second of a slow page, and how often it reads.
SLOW_BYTES, SLOW_EVERY_S = 20_000, 0.5
# A bad page that was sent away comes again after this, as the real one does at first.
AGAIN_S = 0.5


def words(value):
    """A masked text frame; a mask of zeros is one."""
    text = json.dumps(value).encode()
    length = bytes([0x80 | len(text)]) if len(text) < 126 else bytes([0x80 | 126]) + len(text).to_bytes(2, "big")
    return b"\x81" + length + bytes(4) + text


class Page:
    """One that behaves."""

    pause_s = 0.0
    shows = ["video", "map", "log"]

    def __init__(self, address):
        self.socket = socket.create_connection(address, timeout=5)
        self.host = f"{address[0]}:{address[1]}"
        self.buffer = bytearray()
        self.got, self.pictures, self.maps = 0, 0, 0
        self.next_read = 0.0
        self.greet()
        self.socket.setblocking(False)

    def greet(self):
        key = base64.b64encode(os.urandom(16)).decode()
        self.socket.sendall(f"GET /ws HTTP/1.1\r\nHost: {self.host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                            f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n\r\n".encode())
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            if not (byte := self.socket.recv(1)):
                raise OSError("the console has closed the connection")
            head += byte
        if b" 101 " not in head:
            raise OSError(head[:80])
        self.socket.sendall(words({"hello": {}}) + words({"show": self.shows}))

    def take(self):
        """False once it was sent away."""
        try:
            chunk = self.socket.recv(1 << 18)
        except BlockingIOError:
            return True
        except OSError:
            return False
        if not chunk:
            return False
        self.got += len(chunk)
        self.buffer += chunk
        while (size := self.message()) is not None:
            del self.buffer[:size]
        return True

    def message(self):
        """Deals with the first message of the buffer; its size, or None if it is not whole."""
        b = self.buffer
        if len(b) < 2:
            return None
        length, start = b[1] & 0x7F, 2
        if length >= 126:
            start = 4 if length == 126 else 10
            if len(b) < start:
                return None
            length = int.from_bytes(b[2:start], "big")
        if len(b) < start + length:
            return None
        opcode = b[0] & 0x0F
        if opcode == 9:
            self.say(b"\x8a" + bytes([0x80 | length]) + bytes(4) + bytes(b[start:start + length]))
        elif opcode == 2 and length and b[start] in (FRAME, MAP):
            self.pictures += b[start] == FRAME
            self.maps += b[start] == MAP
            self.say(words({"seen": b[start]}))
        return start + length

    def say(self, data):
        try:
            self.socket.send(data)
        except OSError:
            pass


class Whole(Page):
    """With all that the live view shows at first."""

    shows = [*Page.shows, "obstacles"]


class Deaf(Page):
    """Never reads."""

    pause_s = float("inf")

    def take(self):
        return True


class Slow(Page):
    pause_s = SLOW_EVERY_S

    def take(self):
        try:
            chunk = self.socket.recv(int(SLOW_BYTES * SLOW_EVERY_S))
        except BlockingIOError:
            return True
        except OSError:
            return False
        self.got += len(chunk)
        return bool(chunk)


def rule_breaker(what):
    class Bad(Page):
        def greet(self):
            if what == "request":
                self.socket.sendall(b"GET / HTTP/1.1\r\nX: " + b"x" * 60_000)
                return
            super().greet()
            self.socket.sendall({"flood": words({"seen": FRAME}) * 1000, "nonsense": b"\x81\x02xx", "large": b"\x81\xff" + bytes(7) + b"\x10" + bytes(64)}[what])

        def message(self):
            return len(self.buffer) or None

    return Bad


KINDS = {
    "0": [],
    "1": [Page],
    "20": [Page] * 20,
    "1, with obstacles": [Whole],
    "20, most of them bad": [Page] * 8 + [Deaf] * 4 + [Slow] * 4 + [rule_breaker(w) for w in ("flood", "nonsense", "large", "request")],
}


class Crowd(threading.Thread):
    """All pages of a replay, in one thread."""

    def __init__(self, address, kinds):
        super().__init__()
        self.address, self.kinds = address, kinds
        self.ending = threading.Event()
        self.pages, self.sent_away = [], 0

    def run(self):
        watched = selectors.DefaultSelector()
        waiting = [(0.0, kind) for kind in self.kinds]
        while not self.ending.is_set():
            now = time.monotonic()
            for when, kind in [w for w in waiting if w[0] <= now]:
                waiting.remove((when, kind))
                try:
                    page = kind(self.address)
                except OSError:
                    waiting.append((now + AGAIN_S, kind))
                    self.sent_away += 1
                    continue
                self.pages.append(page)
                watched.register(page.socket, selectors.EVENT_READ, (page, kind))
            # Those that do not read now are not waited for.
            for key, (page, kind) in [(k, k.data) for k, _ in watched.select(0.01)]:
                if page.next_read > now:
                    continue
                page.next_read = now + page.pause_s
                if not page.take():
                    watched.unregister(key.fileobj)
                    page.socket.close()
                    self.sent_away += 1
                    waiting.append((now + AGAIN_S, kind))
            if any(page.pause_s for page in self.pages):
                time.sleep(0.005)
        for page in self.pages:
            page.socket.close()

    def end(self):
        self.ending.set()
        self.join()


def replay(way, address, console, recording, config, log, count):
    """One replay with these pages."""
    crowd = Crowd(address, KINDS[way])
    crowd.start()
    told = paired.instructions(way, recording, config, log) if count else paired.replay(way, recording, config, log, {"console": console.pid})
    crowd.end()
    if console.poll() is not None:
        sys.exit("the console has ended")
    if count:
        return told
    good = [page for page in crowd.pages if type(page) in (Page, Whole)]
    told["bytes"] = statistics.median([p.got / told["seconds"] / 1000 for p in good]) if good else None
    told["pictures"] = min([p.pictures / told["seconds"] for p in good]) if good else None
    return told | {"sent_away": crowd.sent_away}


def row(way, runs, base):
    """One way beside the runs of the same rounds without a page."""
    return [way, *paired.daemon_columns(runs, base), paired.mid("console", runs, "{:.0f}"), paired.mid("pictures", runs, "{:.1f}"),
            paired.mid("bytes", runs, "{:.0f}"), sum(r["sent_away"] for r in runs)]


def main():
    count = sys.argv[4:] == ["count"]
    if len(sys.argv) != 4 + count or not sys.argv[1].isdigit():
        sys.exit(__doc__)
    rounds, recording, config = int(sys.argv[1]), sys.argv[2], sys.argv[3]
    with tempfile.TemporaryDirectory() as folder:
        if count:
            recording = os.path.join(folder, "slowed")
            paired.slowed(sys.argv[2], recording)
        log = os.path.join(folder, "log")
        open(log, "w", encoding="utf-8").close()
        told = open(os.path.join(folder, "console"), "w+", encoding="utf-8")
        console = subprocess.Popen(["cairn", "console", "--listen", "127.0.0.1:0", "--log-file", log], stdin=subprocess.DEVNULL, stderr=told)
        try:
            deadline, found = time.monotonic() + 20, None
            while not found and time.monotonic() < deadline and console.poll() is None:
                time.sleep(0.1)
                found = re.search(r"http://([\d.]+):(\d+)/", pathlib.Path(told.name).read_text())
            if not found:
                sys.exit("the console does not say where it listens")
            address = (found[1], int(found[2]))
            runs = paired.rounds(WAYS, rounds, lambda way: replay(way, address, console, recording, config, log, count))
        finally:
            console.terminate()
            console.wait(10)
    base = runs[WAYS[0]]
    if count:
        return paired.show_instructions("pages", runs, base)
    heads = ["pages", *paired.DAEMON_HEADS, "console's CPU, % of a core", "pictures a second of the poorest page", "kB a second a page", "pages sent away"]
    paired.show(heads, [row(way, runs[way], base) for way in WAYS])
    paired.tell_spread(base, "Without a page")


if __name__ == "__main__":
    main()
