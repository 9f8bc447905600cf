"""The hardened unit of the console: that it starts, shows the robot, and may do nothing else."""

import base64
import json
import os
import pathlib
import shutil
import socket
import time

from robot import check, now, sh, until
from scenarios.reboot import install

ADDRESS = ("127.0.0.1", 7979)
FRAME, LOG, REPLY, PICTURE, STATE = 5, 6, 7, 8, 1
# The 7979 of /proc/net/tcp, on loopback alone.
LISTENS = "0100007F:1F2B"


def get(lines="Host: 127.0.0.1:7979"):
    """Status line and body of the page, or what came instead."""
    try:
        with socket.create_connection(ADDRESS, timeout=5) as connection:
            connection.sendall(f"GET / HTTP/1.1\r\n{lines}\r\n\r\n".encode())
            answer = b""
            while chunk := connection.recv(65536):
                answer += chunk
        return answer.decode(errors="replace")
    except OSError as error:
        return str(error)


class Page:
    """A page that shows everything."""

    def __init__(self):
        self.connection = socket.create_connection(ADDRESS, timeout=20)
        key = base64.b64encode(os.urandom(16)).decode()
        self.connection.sendall(f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:7979\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                                f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n\r\n".encode())
        self.stream = self.connection.makefile("rb")
        while self.stream.readline() not in (b"\r\n", b""):
            pass
        self.say({"hello": {}})
        self.say({"show": ["video", "map", "log"]})

    def say(self, value):
        text = json.dumps(value).encode()
        check(len(text) < 65536, "a long message")
        self.connection.sendall(b"\x81" + bytes([0x80 | 126]) + len(text).to_bytes(2, "big") + bytes(4) + text)

    def next(self, kind, limit_s=30):
        """The next message of this kind, without its first eight bytes."""
        end = now() + limit_s
        while now() < end:
            head = self.stream.read(2)
            check(len(head) == 2, "the console has closed the page")
            length = head[1] & 0x7F
            if length >= 126:
                length = int.from_bytes(self.stream.read(2 if length == 126 else 8), "big")
            message = self.stream.read(length)
            if head[0] & 0x0F == 2 and message and message[0] in (FRAME, 4):
                self.say({"seen": message[0]})
            if head[0] & 0x0F == 2 and message and message[0] == kind:
                return message[8:]
        check(False, f"no message of kind {kind} within {limit_s} s")

    def state(self, link, limit_s=30):
        end = now() + limit_s
        while now() < end:
            said = json.loads(self.next(STATE))
            if said["link"] == link:
                return said
        check(False, f"never {link}: {said}")

    def reply(self, number):
        while True:
            said = json.loads(self.next(REPLY, 130))
            if said["id"] == number:
                return said


def property_of(name):
    return sh(f"systemctl show -p {name} --value cairn-console")[1].strip()


def within(command, user="cairn"):
    """In the unit's view of the files."""
    return sh(f"nsenter --target {property_of('MainPID')} --mount -- setpriv --reuid {user} --regid {user} --clear-groups sh -c '{command}'")


def console(stage):
    """Copied as the package would install it, with the daemon's unit beside it."""
    install()
    shutil.copy("/mnt/stage/cairn", "/usr/bin/cairn-tools")
    shutil.copy("/mnt/stage/systemd/cairn-console.service", "/etc/systemd/system/cairn-console.service")
    status, text = sh("systemctl daemon-reload && systemctl start cairn && systemctl start cairn-console", 60)
    check(status == 0, f"systemctl start: {text} {sh('journalctl -u cairn-console -n 20 --no-pager')[1]}")
    health = stage.listener()
    began = now()
    camera = stage.usb("mjpeg")
    until(lambda: get().startswith("HTTP/1.1 200 "), 30, "the page is served")
    health.flowing(began, 20)

    page = Page()
    run = page.state("connected")["daemon"]["run_id"]
    check(b"\xff\xd8\xff" in page.next(FRAME), "a picture is no JPEG")
    records = json.loads(page.next(LOG))["records"]
    while not records:
        records = json.loads(page.next(LOG))["records"]
    check(any(r.get("level") for r in records), f"the journal is not read: {records[:2]}")
    page.say({"command": {"id": 1, "action": {"do": "reset"}}})
    check((said := page.reply(1))["ok"], f"reset: {said}")
    def control(number, action):
        page.say({"command": {"id": number, "action": action}})
        check((said := page.reply(number))["ok"], f"{action}: {said}")
        return said["text"], said["terminal"]

    offered = control(5, {"do": "camera_controls"})[0]
    check(all(f"{name} " in offered for name in ("exposure", "gain", "focus")), f"the camera offers {offered}")
    told = control(6, {"do": "set_camera", "control": "exposure", "value": 12.5})
    check(told == ("exposure is 12.5 ms", "cairn command camera exposure 12.5"), f"exposure: {told}")
    until(lambda: "control 1 0x4 = 125" in camera.controls(), 5, "the camera is told the exposure")
    control(7, {"do": "set_camera", "control": "exposure", "value": None})

    for number, which in ((2, "a"), (3, "b")):
        page.say({"take": {"id": number, "which": which}})
        check((said := page.reply(number))["ok"], f"picture {which}: {said}")
        time.sleep(1)
    page.say({"chain": {"id": 4, "method": {"detector": "fast", "matcher": "descriptors", "guided": False}}})
    said = page.reply(4)
    check(said["ok"] and "outcome" in said["text"], f"the two-picture chain within the unit: {said}")

    check(get("Host: evil.example").startswith("HTTP/1.1 403 "), "a foreign host is served")
    until(lambda: "foreign host" in sh("journalctl -q -u cairn-console -o json --no-pager")[1], 5, "the refusal is in the journal")
    check(LISTENS in pathlib.Path("/proc/net/tcp").read_text(), "it does not listen on loopback alone")
    # Not even as root where the unit's view of the files refuses; /run is open in that view, and not the user's.
    refused = [(path, "root") for path in ("/etc/x", "/usr/x", "/opt/x", "/var/lib/cairn/x", "/var/log/x", "/root/x", "/home/x")] + [("/run/x", "cairn")]
    for path, user in refused:
        status, text = within(f"echo > {path}", user)
        check(status != 0 and not os.path.exists(path), f"{user} may write {path}: {text}")
    check(within("echo > /tmp/x && test -e /tmp/x")[0] == 0 and not os.path.exists("/tmp/x"), "its /tmp is not its own")
    check(within("echo > /dev/shm/x && rm /dev/shm/x")[0] == 0, "it cannot meet the daemon in /dev/shm")
    rights = dict(line.split(":\t", 1) for line in pathlib.Path(f"/proc/{property_of('MainPID')}/status").read_text().splitlines() if ":\t" in line)
    found = {key: rights[key].strip() for key in ("CapEff", "CapBnd", "NoNewPrivs", "Seccomp")}
    check(int(found["CapEff"], 16) == int(found["CapBnd"], 16) == 0 and found["NoNewPrivs"] == "1" and found["Seccomp"] == "2", f"rights: {found}")

    pid, restarted = property_of("MainPID"), now()
    check(sh("systemctl restart cairn", 30)[0] == 0, "the daemon's restart")
    until(lambda: page.state("connected")["daemon"]["run_id"] != run, 30, "the page finds the next daemon")
    back = now() - restarted
    check(property_of("MainPID") == pid, "the console was started again with the daemon")
    check(b"\xff\xd8\xff" in page.next(FRAME), "no picture of the next daemon")
    sh(f"kill -9 {pid}")
    until(lambda: property_of("NRestarts") == "1" and get().startswith("HTTP/1.1 200 "), 20, "systemd starts it again after kill -9")
    stop = now()
    status, text = sh("systemctl stop cairn-console", 30)
    took = now() - stop
    check(status == 0 and took < 5 and property_of("Result") == "success", f"stop: {status} {text} {took:.2f} s {property_of('Result')}")
    sh("systemctl stop cairn", 30)
    return {"done": "cairn-console.service: page, pictures, journal, commands, the camera's exposure, two-picture chain; the daemon restarted; kill -9; stop", "recovery_s": back,
            "note": f"recovery: the page shows the next daemon after `systemctl restart cairn`; {len(refused)} places cannot be written, no capability, "
                    f"system calls filtered; stopped in {took:.2f} s"}


SCENARIOS = {"console": console}
