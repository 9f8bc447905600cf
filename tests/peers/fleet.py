"""`cairn fleet` and `cairn map pull` beside bridges of one network; a part of `bridge.py`, which has the router."""

import json
import signal
import socket
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree

import cairn
from programs import Program, until

# A hand-held camera before a wall with a tag, which is the dock: 1 m before and 2 m to the left of the map's origin.
DOCK_CONFIG = """
[simulator]
scenario = "hand_held"
seed = 5
width = 480
height = 360
rate_hz = 15.0
[simulator.tags]
enabled = true
[tag]
size_m = 0.16
[tag.dock]
enabled = true
id = 1
translation_m = [1.0, 2.0, 0.5]
rpy_deg = [0.0, 0.0, 90.0]
"""


def told_last(follower):
    """The last listing of `cairn fleet --json`."""
    if follower.process.poll() is not None:
        sys.exit(f"{follower.name} has ended with {follower.process.returncode}")
    # The last line may be half written.
    lines = follower.log.read_text().split("\n")[:-1]
    return json.loads(lines[-1]) if lines else {"robots": [], "notices": []}


def fleet(program, out, environment, domain):
    """Three bridges of the same daemon in a domain of their own, two of them with one name."""
    there = {**environment, "ROS_DOMAIN_ID": str(domain)}
    # Where the camera sits is asked of a service with two places.
    words = [program, "bridge", "--no-commands", "--rate", "tf_static=0", "--robot"]
    names = {"east": "east", "west": "west", "other_east": "east"}
    bridges = {label: Program(label, [*words, name], out, there) for label, name in names.items()}
    follower = Program("fleet", [program, "fleet", "--json"], out, there)

    def listing():
        return told_last(follower)

    def rows(*wanted):
        """Names and presences, by name and then session; of these alone."""
        robots = listing()["robots"]
        found = sorted((row["name"], row["presence"]) for row in robots)
        return robots if found == sorted(wanted) else None

    robots = until("three robots", 30, lambda: rows(("east", "here"), ("east", "here"), ("west", "here")))
    assert [row["is_name_shared"] for row in robots] == [True, True, False], robots
    assert len({row["session"] for row in robots}) == 3, robots
    until("the scale", 10, lambda: all(row["scale"] == "METRIC" for row in listing()["robots"]))
    for row in listing()["robots"]:
        assert row["state"] and row["health"] in ("ok", "warning", "error") and row["heard_s_ago"] < 5, row
    twins = [notice for notice in listing()["notices"] if notice.startswith("2 robots have the name east")]
    assert len(twins) == 1 and listing()["has_router"], listing()

    bridges["west"].end(signal.SIGKILL)
    robots = until("the one that was killed", 20, lambda: rows(("east", "here"), ("east", "here"), ("west", "gone")))
    west = robots[-1]
    assert west["state"] is None and west["scale"] is None and west["last_state"], west
    assert bridges["other_east"].end(signal.SIGTERM) == 0
    robots = until("one east", 20, lambda: rows(("east", "here"), ("east", "gone"), ("west", "gone")))
    assert not any(row["is_name_shared"] for row in robots) and not listing()["notices"], listing()
    again = Program("west_again", [*words, "west"], out, there)
    until("the one that is back", 20, lambda: rows(("east", "here"), ("east", "gone"), ("west", "here")))

    once = [program, "fleet", "--timeout", "3"]
    told = subprocess.run(once, env=there, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20, check=True).stdout
    assert f"robots in domain {domain}: 2" in told and "metres" in told, told
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    nobody = out / "nobody.json5"
    nobody.write_text(json.dumps({"mode": "peer", "connect": {"endpoints": [f"tcp/127.0.0.1:{port}"], "timeout_ms": -1, "exit_on_failure": False},
                                  "listen": {"endpoints": ["tcp/127.0.0.1:0"]}, "scouting": {"multicast": {"enabled": False}}}))
    alone = subprocess.run([*once, "--json", "--zenoh", nobody], env=there, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20)
    assert alone.returncode == 69 and "no Zenoh router" in alone.stderr, alone
    report = json.loads(alone.stdout)
    assert not report["is_connected"] and not report["robots"] and report["notices"], report
    ended = [program.end(signal.SIGTERM) for program in (follower, bridges["east"], again)]
    assert ended == [0, 0, 0], ended
    print("fleet: three bridges, two of one name, one killed and back; no router is said")


def maps(program, with_zenoh, out, environment, domain):
    """A robot whose daemon does not run has a map, and another one a broken one: who fetches the first can be located in it."""
    there = {**environment, "ROS_DOMAIN_ID": str(domain)}
    walk = out / "walk"
    quietly = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True, "timeout": 120, "check": True}
    subprocess.run([program, "simulate", "--output", walk, "--scenario", "hand_held", "--size", "320x240", "--seconds", "6"], **quietly)
    replay = [program, "replay", walk, "--lockstep", "--quiet", "--map-file"]
    shelves = {name: out / f"maps_{name}" for name in ("west", "broken", "own")}
    for name, folder in shelves.items():
        folder.mkdir()
        (out / f"{name}.toml").write_text(f'[map]\ndirectory = "{folder}"\n')
    original = shelves["west"] / "warehouse.map"
    subprocess.run([*replay, original], **quietly)
    whole = original.read_bytes()
    # Much of it, as a page here and there may be a free one.
    low, high = len(whole) // 4, 3 * len(whole) // 4
    (shelves["broken"] / "warehouse.map").write_bytes(whole[:low] + bytes(b ^ 0x55 for b in whole[low:high]) + whole[high:])

    # Nobody's daemon: the file itself is what is given.
    alone = {**there, "CAIRN_PREFIX": environment["CAIRN_PREFIX"] + "_maps"}
    words = [with_zenoh, "bridge", "--rate", "tf_static=0"]
    names = {"west": "west", "broken": "broken", "twin_a": "twin", "twin_b": "twin"}
    bridges = [Program(f"maps_{label}", [*words, "--robot", name, "--config", out / f"{'broken' if name == 'broken' else 'west'}.toml"], out, alone)
               for label, name in names.items()]

    def pull(*words, code=0):
        told = subprocess.run([with_zenoh, "map", "pull", *words, "--config", out / "own.toml"], env=there, stdin=subprocess.DEVNULL,
                              capture_output=True, text=True, timeout=60)
        assert told.returncode == code, (words, told)
        return told.stdout if code == 0 else told.stderr

    fetched = shelves["own"] / "warehouse.map"
    told = pull("west:warehouse")
    assert "verified" in told and fetched.read_bytes() == whole, told
    assert "already" in pull("west:warehouse", code=73)
    pull("west:warehouse", "--as", "depot")
    pull("west:warehouse", "--output", out / "direct.map")
    assert (shelves["own"] / "depot.map").read_bytes() == (out / "direct.map").read_bytes() == whole
    assert "exists already" in pull("west:warehouse", "--output", out / "direct.map", code=73)

    before = sorted(path.name for path in shelves["own"].iterdir())
    assert "there is no map attic; there are warehouse" in pull("west:attic", code=66)
    assert "is no name of a map" in pull("west:../broken", "--as", "x", code=66)
    assert "is broken" in pull("broken:warehouse", "--as", "x", code=4)
    assert "2 robots have the name twin" in pull("twin:warehouse", "--as", "x", code=69)
    assert "no bridge of nobody" in pull("nobody:warehouse", "--as", "x", "--wait", "1", code=69)
    assert sorted(path.name for path in shelves["own"].iterdir()) == before, "something was left behind"

    located = out / "located.txt"
    subprocess.run([*replay, fetched, "--localise", "--trajectory", located], **quietly)
    poses = [line for line in located.read_text().splitlines() if not line.startswith("#")]
    assert len(poses) > 60, f"located in {len(poses)} frames"
    assert fetched.read_bytes() == whole
    ended = [bridge.end(signal.SIGTERM) for bridge in bridges]
    assert ended == [0] * len(bridges), ended
    print(f"maps: {len(whole) / 1e6:.1f} MB fetched, {len(poses)} frames located in it; broken, ambiguous, missing and existing ones refused")


def docked(program, with_zenoh, out, environment, domain):
    """A robot whose map is in the frame of its dock, told by two bridges as if it were two: both are drawn where it is, and a third one is not drawn."""
    here = {**environment, "ROS_DOMAIN_ID": str(domain), "CAIRN_PREFIX": environment["CAIRN_PREFIX"] + "_dock"}
    config, plot = out / "dock.toml", out / "fleet.svg"
    config.write_text(DOCK_CONFIG)
    words = [program, "demo", "--quiet", "--seconds", "60", "--output", out / "dock", "--config", config]
    running = Program("docked", words, out, here)
    words = [with_zenoh, "bridge", "--no-commands", "--rate", "tf_static=0", "--rate", "diagnostics=0.5", "--robot"]
    bridges = [Program(f"dock_{name}", [*words, name], out, here) for name in ("first", "second")]
    nobody = {**here, "CAIRN_PREFIX": environment["CAIRN_PREFIX"] + "_none"}
    bridges.append(Program("dock_none", [*words, "third"], out, nobody))
    follower = Program("dock_fleet", [with_zenoh, "fleet", "--json", "--plot", plot], out, here)
    poses = cairn.Client(here["CAIRN_PREFIX"]).poses()

    def drawn():
        if follower.process.poll() is not None:
            sys.exit(f"fleet has ended with {follower.process.returncode}")
        return plot.exists() and "dock_36h11_1: 2 robots" in plot.read_text()

    until("both robots in the plot", 50, drawn)
    rows = [json.loads(line) for line in subprocess.run(
        [with_zenoh, "fleet", "--json", "--timeout", "4", "--plot", out / "once.svg"], env=here, stdin=subprocess.DEVNULL, capture_output=True, text=True,
        timeout=20, check=True).stdout.splitlines()][0]["robots"]
    pose = until("a pose", 10, lambda: poses.wait(0.5))
    first, second, third = rows
    assert first["map_frame"] == second["map_frame"] == "dock_36h11_1" and third["place"] is None, rows
    for row in (first, second):
        # A hand moves by less than half a metre a second, and the two are some seconds apart.
        off = [row["place"][axis] - pose.position[i] for i, axis in enumerate(("x_m", "y_m"))]
        assert max(map(abs, off)) < 2.0, (row, list(pose.position))
    root = ElementTree.fromstring((out / "once.svg").read_text())
    texts = [node.text for node in root.iter("{http://www.w3.org/2000/svg}text")]
    assert "first" in texts and "second" in texts and texts[-1].endswith(": third"), texts
    ended = [one.end(signal.SIGTERM) for one in (follower, *bridges)]
    assert ended == [0] * len(ended), ended
    running.end(signal.SIGINT)
    print(f"plot: both robots of one dock, at ({first['place']['x_m']:.2f}, {first['place']['y_m']:.2f}) m in its frame")


def shared(program, with_zenoh, out, environment, domain, config):
    """The current map of a daemon, fetched while it grows. A second robot that goes on in it is in one plot with the first, and where it was
    once it publishes its map elsewhere."""
    there = {**environment, "ROS_DOMAIN_ID": str(domain)}
    robots = {name: {**there, "CAIRN_PREFIX": f"{environment['CAIRN_PREFIX']}_{name}"} for name in ("first", "second")}
    bridges = []
    for name in robots:
        folder = out / f"shared_{name}"
        folder.mkdir()
        maps = f'[daemon]\nsource = "simulator"\n{config}[map]\nfile = "{folder}/warehouse.map"\ndirectory = "{folder}"\n'
        (out / f"{name}.toml").write_text(maps)

    def start(name):
        words = ["--config", out / f"{name}.toml"]
        bridges.append(Program(f"shared_{name}_bridge", [with_zenoh, "bridge", "--rate", "tf_static=0", "--robot", name, *words], out, robots[name]))
        running = Program(f"shared_{name}", [program, "run", *words], out, robots[name])
        client = cairn.Client(robots[name]["CAIRN_PREFIX"])
        poses = client.poses()

        def is_located():
            pose = poses.wait(0.5)
            return pose is not None and pose.state == "TRACKING" and pose.scale == "METRIC" and pose

        until(f"{name}: a pose in metres", 60, is_located)
        return running, client, is_located

    first, client, first_pose = start("first")
    health = client.health()
    until("a map", 30, lambda: (report := health.wait(0.5)) is not None and report.keyframes >= 12)
    pull = [with_zenoh, "map", "pull", "first:warehouse", "--config", out / "second.toml"]
    told = subprocess.run(pull, env=there, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=60)
    assert told.returncode == 0 and "verified" in told.stdout, told
    copies = out / "shared_first" / "copies"
    assert copies.is_dir() and not list(copies.iterdir()), "the copy that was made for the bridge is left"
    fetched = until("the newest keyframes of the first", 10, lambda: health.wait(0.5)).keyframes
    assert first.said()["map file not written, tried again later"] == 0

    second, other, second_pose = start("second")
    assert second.said()["map loaded"] == 1, second.said()
    plot = out / "shared.svg"
    follower = Program("shared_fleet", [with_zenoh, "fleet", "--json", "--plot", plot], out, there)

    def listed():
        told_last(follower)
        once = [with_zenoh, "fleet", "--json", "--timeout", "4", "--plot", out / "shared_once.svg"]
        done = subprocess.run(once, env=there, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20, check=True)
        rows = json.loads(done.stdout.splitlines()[0])["robots"]
        return rows if len(rows) == 2 and all(row["place"] for row in rows) else None

    rows = until("both robots in one frame", 40, listed)
    frame = rows[0]["map_frame"]
    assert rows[1]["map_frame"] == frame and frame.startswith("map_"), rows
    until("both robots in the plot", 20, lambda: plot.exists() and f"{frame}: 2 robots" in plot.read_text())

    def near(row, pose, shift=(0.0, 0.0)):
        # Bases drive by less than half a metre a second, and the two are some seconds apart.
        off = [row["place"][axis] + shift[i] - pose.position[i] for i, axis in enumerate(("x_m", "y_m"))]
        assert max(map(abs, off)) < 3.0, (row, list(pose.position), shift)

    for row, pose in zip(rows, (first_pose, second_pose)):
        near(row, until("a pose", 10, pose))
    before = until("a pose", 10, second_pose)
    other.set_pose(before.position[0] + 50.0, before.position[1] - 20.0, before.yaw)
    until("poses elsewhere", 10, lambda: (pose := second_pose()) and pose.position[0] > before.position[0] + 40)
    time.sleep(2)
    rows = until("both robots in one frame again", 40, listed)
    assert [row["map_frame"] for row in rows] == [frame] * 2, rows
    near(rows[1], until("a pose", 10, second_pose), (50.0, -20.0))
    ended = [one.end(signal.SIGTERM) for one in (follower, *bridges, second, first)]
    assert ended == [0] * len(ended), ended
    print(f"shared map: fetched from a running daemon with {fetched} keyframes, its copy removed; both robots in one plot, after an initial pose as well")
