"""Cameras that vanish and come back."""

import json
import os
import signal
import time

from robot import CAMERA_GONE, CONFIG, check, now, row, summary, until

RETURN_LIMIT_S = 2.0


def tracking(health, after, limit_s=25):
    return health.wait(lambda r: r["state"] == "TRACKING" and not CAMERA_GONE & set(r["errors"]), limit_s, "a tracked pose", after)


def unplug_cycles(stage):
    """Unplugged while it streams, plugged in again; every third time under another node number, once with another camera there."""
    cycles = 20 if stage.full else 3
    camera = stage.usb("mjpeg")
    daemon = stage.daemon()
    health = stage.listener()
    began = now()
    health.flowing(began, 20)
    first = tracking(health, began)
    frames, poses, maps, nodes = [], [], 0, set()
    resets = first["reset_counter"]
    told = []
    for cycle in range(cycles):
        # An open file keeps the number of a node that is gone, so the camera comes back under another.
        held = os.open(camera.node, os.O_RDWR) if cycle % 3 == 1 else None
        stranger = None
        gone = camera.unplug()
        camera.close()
        lost = health.wait(lambda r: "NO_CAMERA" in r["errors"], 2, "NO_CAMERA", gone)
        check(lost["state"] != "TRACKING", f"still {summary(lost)} without a camera")
        told.append(lost["t"] - gone)
        if cycle == 2:
            stranger = stage.usb("yuyv", serial="B2")
            time.sleep(1.5)
            check("NO_CAMERA" in health.last()["errors"], "the daemon took a camera that is not its own")
        time.sleep(0.5 if cycle % 2 else 2.5)
        before = health.last()
        # Elsewhere on its way, as a robot that was carried on.
        camera = stage.usb("mjpeg", start=37 * (cycle + 1))
        nodes.add(camera.node)
        back = health.flowing(camera.appeared - 0.2, 10)
        frames.append(max(0.0, back["t"] - camera.appeared))
        pose = tracking(health, back["t"] - 0.01)
        poses.append(max(0.0, pose["t"] - camera.appeared))
        if pose["map_id"] != before["map_id"]:
            maps += 1
            check(pose["reset_counter"] > before["reset_counter"], "a new map without a reset in the counter")
        if held is not None:
            os.close(held)
        if stranger is not None:
            stranger.unplug()
    check(daemon.alive(), "the daemon ended")
    check(daemon.said("camera lost"), "the log does not say that the camera was lost")
    slowest = max(frames)
    check(slowest < RETURN_LIMIT_S, f"frames only {slowest:.2f} s after the camera's return")
    last = health.last()
    note = (f"{cycles} cycles; nodes {' '.join(sorted(nodes))}; NO_CAMERA within {max(told):.2f} s; "
            f"tracked again within {max(poses):.2f} s: {cycles - maps} times in the map it had, {maps} in a new one "
            f"(reset counter {resets} to {last['reset_counter']})")
    return row(health, began, "USB camera unplugged while it streams, plugged in again; another camera beside it once", slowest, note)


def another_place(stage):
    """Unplugged, carried to another place, plugged in: no pose may come out of the old map; a new one begins, and the reset counter says so. And back
    again: the old map is gone, which the counter says once more."""
    camera = stage.usb("mjpeg")
    daemon = stage.daemon()
    health = stage.listener()
    poses = stage.listener(what="")
    began = now()
    last = tracking(health, began)
    notes, slowest = [], 0.0
    for place, name in (("elsewhere-", "another place"), ("", "the first place")):
        gone = camera.unplug()
        camera.close()
        health.wait(lambda r: "NO_CAMERA" in r["errors"], 2, "NO_CAMERA", gone)
        time.sleep(3)
        camera = stage.usb("mjpeg", place=place)
        new = health.wait(lambda r: r["state"] == "TRACKING" and r["reset_counter"] > last["reset_counter"], 40, f"tracking in {name}", camera.appeared)
        check(new["map_id"] != last["map_id"], "a reset without a new map")
        time.sleep(1)
        between = [p for p in poses.since(camera.appeared - 0.2)]
        check(between, "no poses")
        for pose in between:
            check(pose["state"] != "TRACKING" or pose["map_id"] != last["map_id"], f"a pose in the map of the place that was left: {pose}")
            check((pose["reset_counter"] > last["reset_counter"]) == (pose["map_id"] != last["map_id"]), f"map and counter disagree: {pose}")
        lost = [p for p in between if p["state"] == "LOST"]
        check(lost, "the planner was not told that tracking is lost")
        slowest = max(slowest, new["t"] - camera.appeared)
        notes.append(f"{name}: {len(lost)} poses LOST, reset counter {last['reset_counter']} to {new['reset_counter']}, map {last['map_id']} to {new['map_id']}, "
                     f"tracked after {new['t'] - camera.appeared:.1f} s")
        last = new
    check(daemon.said('"message":"reset"'), "the log does not speak of the reset")
    return row(health, began, "unplugged, plugged in looking at another place, and back", slowest, "; ".join(notes) + "; no pose in a map of the place that was left")


def no_camera_at_start(stage):
    """Waits, says so, starts when the camera comes; with a calibration file, and without, where the camera's identity tells it. SIGHUP meanwhile
    reloads the configuration."""
    rows = []
    for stored in (False, True):
        folder = "/var/lib/cairn/cameras"
        if stored:
            os.makedirs(folder, exist_ok=True)
            with open("/mnt/stage/camera.toml", encoding="utf-8") as source:
                text = source.read()
            with open(f"{folder}/camera.toml", "w", encoding="utf-8") as target:
                target.write(text)
        began = now()
        daemon = stage.daemon(calibration=None if stored else "camera.yaml")
        health = stage.listener()
        health.wait(lambda r: "NO_CAMERA" in r["errors"], 10, "NO_CAMERA", began)
        time.sleep(3)
        check(daemon.alive(), f"the daemon ended: {daemon.lines()[-1:]}")
        check(daemon.said("no camera|not there"), "the log does not say that there is no camera")
        CONFIG.write_text(CONFIG.read_text() + '[log]\nlevel = "debug"\n')
        daemon.process.send_signal(signal.SIGHUP)
        check(json.loads(daemon.wait_said("configuration reloaded", 3))["level"] == "debug", "the level was not taken over")
        check(daemon.alive(), "SIGHUP ended a daemon that waits for its camera")
        quiet = health.last()["t"]
        camera = stage.usb("mjpeg")
        back = health.flowing(camera.appeared - 0.2, 10)
        recovery = max(0.0, back["t"] - camera.appeared)
        check(recovery < RETURN_LIMIT_S, f"frames only {recovery:.2f} s after the camera came")
        check(health.last()["t"] > quiet, "no health")
        how = "no camera at start, calibration found by the camera's identity" if stored else "no camera at start"
        rows.append(row(health, began, how, recovery, "SIGHUP meanwhile: reloaded"))
        daemon.close()
        health.close()
        camera.unplug()
    return rows


def two_daemons_end_quickly(stage):
    """An orderly stop, with a camera and without one."""
    rows = []
    for plugged in (True, False):
        camera = stage.usb("mjpeg") if plugged else None
        daemon = stage.daemon()
        health = stage.listener()
        began = now()
        if plugged:
            health.flowing(began, 20)
        else:
            health.wait(lambda r: "NO_CAMERA" in r["errors"], 10, "NO_CAMERA", began)
        asked = now()
        daemon.process.terminate()
        status = daemon.process.wait(5)
        took = now() - asked
        check(status == 0, f"status {status}")
        check(took < 1.0, f"it took {took:.2f} s")
        health.close()
        if camera:
            camera.unplug()
        rows.append({"done": f"SIGTERM, {'streaming' if plugged else 'no camera'}", "note": f"ended in {took:.2f} s, status 0"})
    return rows


SCENARIOS = {"unplug_cycles": unplug_cycles, "another_place": another_place, "no_camera_at_start": no_camera_at_start, "orderly_stop": two_daemons_end_quickly}
