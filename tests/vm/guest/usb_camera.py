#!/usr/bin/env python3
"""A USB webcam made of software, which the kernel's own uvcvideo drives.

vhci-hcd takes a socket and speaks USB/IP on it; this program answers at the other end as a UVC 1.1 camera with one
bulk endpoint and the controls that matter to mapping (exposure, focus, power-line frequency, gain, white balance).
Closing the socket (ending the program) is a pulled plug. Works as root in the guest only.

Faults are asked for on stdin, one a line:
    pause | go                stops delivering, goes on
    rate HZ                   delivers so many frames a second, whatever was negotiated
    broken N                  the next N frames are garbage (MJPEG) or carry the error bit (YUYV)
    short N                   the next N frames end after a third of their bytes
    slow S                    every answer on endpoint 0 comes S seconds late: a camera that hardly answers while it is opened; 0: at once
"""

import argparse
import os
import select
import signal
import socket
import struct
import sys
import time
import uuid

SUBMIT, UNLINK, RETURN_SUBMIT, RETURN_UNLINK = 1, 2, 3, 4
STALL = -32
UNLINKED = -104
BLOCK = 16384  # bytes of a transfer of uvcvideo's, and of a payload with its header
CAMERA, PROCESSING, OUTPUT = 1, 2, 3  # units

# (unit, selector): bytes, smallest, largest, step (of a bit mask: what is supported), default
CONTROLS = {
    (CAMERA, 0x02): (1, 1, 8, 0x09, 8),  # exposure mode: 1 manual, 8 aperture priority
    (CAMERA, 0x03): (1, 0, 1, 1, 1),  # exposure may lower the rate
    (CAMERA, 0x04): (4, 3, 2047, 1, 250),  # exposure time, 100 us
    (CAMERA, 0x06): (2, 0, 250, 5, 0),  # focus
    (CAMERA, 0x08): (1, 0, 1, 1, 1),  # autofocus
    (PROCESSING, 0x04): (2, 0, 255, 1, 64),  # gain
    (PROCESSING, 0x05): (1, 0, 2, 1, 2),  # power line: off, 50 Hz, 60 Hz
    (PROCESSING, 0x0A): (2, 2800, 6500, 1, 4600),  # white balance, K
    (PROCESSING, 0x0B): (1, 0, 1, 1, 1),  # automatic white balance
}
CAMERA_BITS = 1 << 1 | 1 << 2 | 1 << 3 | 1 << 5 | 1 << 17
PROCESSING_BITS = 1 << 6 | 1 << 9 | 1 << 10 | 1 << 12


def block(kind, *parts):
    """A descriptor: length, type, content."""
    body = b"".join(parts)
    return bytes([len(body) + 2, kind]) + body


class Picture:
    """What the camera sends: the frames, and which faults they are to have."""

    def __init__(self, paths, rate_hz, compressed):
        self.files = [open(path, "rb").read() for path in paths]
        self.compressed = compressed
        self.period = 1 / rate_hz
        self.sent = self.broken = self.short = 0
        self.parity = 0
        self.paused = False
        self.slow = 0.0
        self.next_at = time.monotonic()
        self.pieces = []

    def command(self, words):
        verb, value = words[0], words[1] if len(words) > 1 else "0"
        if verb == "pause":
            self.paused = True
        elif verb == "go":
            self.paused = False
        elif verb == "rate":
            self.period = 1 / float(value)
        elif verb == "broken":
            self.broken = int(value)
        elif verb == "short":
            self.short = int(value)
        elif verb == "slow":
            self.slow = float(value)
        else:
            print(f"usb_camera: {verb}?", file=sys.stderr, flush=True)

    def restart(self):
        self.pieces = []
        self.next_at = time.monotonic()

    def wait(self):
        """Seconds until there is something to send."""
        if self.pieces:
            return 0.0
        return 3600.0 if self.paused else self.next_at - time.monotonic()

    def piece(self):
        if not self.pieces:
            self.cut()
        return self.pieces.pop(0)

    def cut(self):
        """The next frame as payloads: two bytes of header (length; frame parity, end of frame, error), then data."""
        data, error = self.files[self.sent % len(self.files)], 0
        if self.broken > 0:
            self.broken -= 1
            error = 0 if self.compressed else 0x40
            data = bytes(b ^ 0x5A for b in data[:2000]) if self.compressed else data
        elif self.short > 0:
            self.short -= 1
            data = data[:len(data) // 3]
        room = BLOCK - 2
        for start in range(0, len(data), room):
            last = start + room >= len(data)
            self.pieces.append(bytes([2, 0x80 | error | self.parity | (2 if last else 0)]) + data[start:start + room])
        self.parity ^= 1
        self.sent += 1
        self.next_at = max(self.next_at + self.period, time.monotonic() - self.period)


class Camera:
    """Descriptors and requests on endpoint 0. A request's answer is bytes, or None for a stall."""

    def __init__(self, picture, size, rate_hz, serial):
        self.picture, self.serial = picture, serial
        self.values = {key: control[4] for key, control in CONTROLS.items()}
        interval = round(10_000_000 / rate_hz)
        largest = max(map(len, picture.files))
        self.probe = struct.pack("<HBBI5H3I4B", 1, 1, 1, interval, 0, 0, 0, 0, 0, largest, BLOCK, 48_000_000, 3, 0, 0, 0)
        self.device = block(1, struct.pack("<HBBBBHHHBBBB", 0x0200, 0xEF, 2, 1, 64, 0x1D6B, 0x0102, 0x0100, 1, 2, 3, 1))
        self.configuration = self.describe(size, rate_hz, interval, largest)

    def describe(self, size, rate_hz, interval, largest):
        camera = block(0x24, struct.pack("<BBHBBHHHB", 2, CAMERA, 0x0201, 0, 0, 0, 0, 0, 3), CAMERA_BITS.to_bytes(3, "little"))
        processing = block(0x24, struct.pack("<BBBHB", 5, PROCESSING, CAMERA, 0, 2), PROCESSING_BITS.to_bytes(2, "little"), b"\0\0")
        output = block(0x24, struct.pack("<BBHBBB", 3, OUTPUT, 0x0101, 0, PROCESSING, 0))
        units = camera + processing + output
        header = block(0x24, struct.pack("<BHHIBB", 1, 0x0110, 13 + len(units), 48_000_000, 1, 1))
        rate = int(largest * 8 * rate_hz)
        if self.picture.compressed:
            form, frame_kind = block(0x24, bytes([6, 1, 1, 1, 1, 0, 0, 0, 0])), 7
        else:
            guid = b"YUY2" + uuid.UUID("00000000-0000-0010-8000-00aa00389b71").bytes_le[4:]
            form, frame_kind = block(0x24, bytes([4, 1, 1]), guid, bytes([16, 1, 0, 0, 0, 0])), 5
        frame = block(0x24, struct.pack("<BBBHHIIIIBI", frame_kind, 1, 0, *size, rate, rate, largest, interval, 1, interval))
        colour = block(0x24, bytes([13, 1, 1, 4]))
        input_header = block(0x24, struct.pack("<BBHBBBBBBBB", 1, 1, 14 + len(form + frame + colour), 0x81, 0, OUTPUT, 0, 0, 0, 1, 0))
        body = (block(11, bytes([0, 2, 14, 3, 0, 2]))
                + block(4, bytes([0, 0, 0, 14, 1, 0, 2])) + header + units
                + block(4, bytes([1, 0, 1, 14, 2, 0, 0])) + input_header + form + frame + colour
                + block(5, struct.pack("<BBHB", 0x81, 2, 512, 0)))
        return block(2, struct.pack("<HBBBBB", 9 + len(body), 2, 1, 0, 0x80, 250)) + body

    def text(self, index):
        if index == 0:
            return block(3, b"\x09\x04")
        words = {1: "Cairn", 2: "Webcam of software", 3: self.serial}.get(index)
        return block(3, words.encode("utf-16-le")) if words else None

    def request(self, kind, request, value, index, data):
        high = value >> 8
        if kind == 0x80 and request == 6:
            return {1: self.device, 2: self.configuration}.get(high) or (self.text(value & 255) if high == 3 else None)
        if kind & 0x60 == 0:  # the other standard requests: status, configuration, interface, halt
            if request in (1, 11):
                self.picture.restart()
            return {0: b"\0\0", 10: b"\0"}.get(request, b"") if kind & 0x80 else b""
        if index & 0xFF == 1:
            return self.stream_request(request, high)
        return self.control_request(request, (index >> 8, high), data)

    def stream_request(self, request, selector):
        if selector not in (1, 2):  # probe, commit
            return None
        if request == 1:
            if selector == 2:
                self.picture.restart()
            return b""
        return {0x85: struct.pack("<H", len(self.probe)), 0x86: b"\x03"}.get(request, self.probe)

    def control_request(self, request, key, data):
        control = CONTROLS.get(key)
        if control is None:
            return None
        size, low, high, step, default = control
        if request == 1:
            self.values[key] = int.from_bytes(data[:size], "little")
            print(f"control {key[0]} {key[1]:#x} = {self.values[key]}", flush=True)
            return b""
        if request == 0x85:
            return struct.pack("<H", size)
        if request == 0x86:
            return b"\x03"
        number = {0x81: self.values[key], 0x82: low, 0x83: high, 0x84: step, 0x87: default}.get(request)
        return None if number is None else number.to_bytes(size, "little")


class Plug:
    """The socket: USB/IP's messages of 48 bytes and what follows them."""

    def __init__(self, link, camera):
        self.link, self.camera = link, camera
        self.waiting = []  # transfers of the bulk endpoint that want data
        self.late = []  # answers on endpoint 0 that are held back: when they were due, transfer, arguments
        self.buffer = bytearray()

    def answer(self, number, status=0, data=b"", length=None):
        head = struct.pack(">5IiIiii8x", RETURN_SUBMIT, number, 0, 0, 0, status, len(data) if length is None else length, 0, 0, 0)
        self.link.sendall(head + data)

    def serve(self):
        picture = self.camera.picture
        inputs = [self.link, sys.stdin]
        while True:
            wait = min(max(picture.wait(), 0.0), 0.5) if self.waiting else 0.5
            wait = min(wait, 0.05) if self.late else wait
            ready, _, _ = select.select(inputs, [], [], wait)
            if sys.stdin in ready:
                line = os.read(0, 4096).decode()
                if not line:
                    inputs.remove(sys.stdin)
                for command in line.splitlines():
                    if command.split():
                        picture.command(command.split())
            if self.link in ready:
                more = self.link.recv(1 << 16)
                if not more:
                    return
                self.buffer += more
                self.take()
            while self.waiting and picture.wait() <= 0:
                self.answer(self.waiting.pop(0), data=picture.piece())
            while self.late and time.monotonic() >= self.late[0][0] + picture.slow:
                _, number, options = self.late.pop(0)
                self.answer(number, **options)

    def take(self):
        """Whole messages from the buffer."""
        while len(self.buffer) >= 48:
            verb, number, _, inward, endpoint = struct.unpack(">5I", self.buffer[:20])
            if verb == UNLINK:
                victim = struct.unpack(">I", self.buffer[20:24])[0]
                del self.buffer[:48]
                held = [late for late in self.late if late[1] == victim]
                status = UNLINKED if victim in self.waiting or held else 0
                if victim in self.waiting:
                    self.waiting.remove(victim)
                self.late = [late for late in self.late if late[1] != victim]
                self.link.sendall(struct.pack(">5Ii24x", RETURN_UNLINK, number, 0, 0, 0, status))
                continue
            length = struct.unpack(">i", self.buffer[24:28])[0]
            outward = 0 if inward else length
            if len(self.buffer) < 48 + outward:
                return
            setup, data = bytes(self.buffer[40:48]), bytes(self.buffer[48:48 + outward])
            del self.buffer[:48 + outward]
            if endpoint != 0:
                self.waiting.append(number)
                continue
            kind, request, value, index, _ = struct.unpack("<BBHHH", setup)
            reply = self.camera.request(kind, request, value, index, data)
            if reply is None:
                options = {"status": STALL}
            elif inward:
                options = {"data": reply[:length]}
            else:
                options = {"length": length}
            if self.camera.picture.slow:
                self.late.append((time.monotonic(), number, options))
            else:
                self.answer(number, **options)


def plug_in(device_end):
    """Hands the socket to the first free high-speed port."""
    base = "/sys/devices/platform/vhci_hcd.0"
    with open(f"{base}/status", encoding="ascii") as table:
        rows = [line.split() for line in table.readlines()[1:]]
    port = next((int(row[1]) for row in rows if row[0] == "hs" and row[2] == "004"), None)
    if port is None:
        raise SystemExit("usb_camera: no free port")
    with open(f"{base}/attach", "w", encoding="ascii") as file:
        file.write(f"{port} {device_end.fileno()} {port + 1} 3")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--format", choices=["mjpeg", "yuyv"], required=True)
    parser.add_argument("--size", default="320x240")
    parser.add_argument("--rate", type=float, default=15.0)
    parser.add_argument("--serial", default="A1")
    parser.add_argument("--start", type=int, default=0, help="first frame that is sent")
    parser.add_argument("files", nargs="+")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    picture = Picture(args.files, args.rate, args.format == "mjpeg")
    picture.sent = args.start
    camera = Camera(picture, (width, height), args.rate, args.serial)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
    plug_in(theirs)
    theirs.close()
    Plug(ours, camera).serve()


if __name__ == "__main__":
    main()
