"""vivid's error injection: each of its controls, and the driver unbound and bound again."""

import time

from robot import CAMERA_GONE, Failure, check, now, row, summary, until

RETURN_LIMIT_S = 2.0
# Errors of calls that are made once, at the start of a stream, show when the stream is broken after them.
AT_START = {"inject_vidioc_queue_setup_error", "inject_queue_setup_error", "inject_vidioc_reqbufs_error", "inject_vidioc_streamon_error",
            "inject_start_streaming_error", "inject_stop_streaming_error"}
NO_FAULT = {"wrap_sequence_number", "wrap_timestamp", "timestamp_source", "reduced_framerate"}


def names(camera):
    listed = camera.controls()
    picked = [n for n in listed if n.startswith("inject") or n in ("disconnect", "percentage_of_dropped_buffers", "wrap_sequence_number")]
    check(any("fatal" in n for n in picked), f"vivid lists no error injection: {listed}")
    return picked


def injections(stage):
    rows = []
    camera = stage.vivid()
    daemon = stage.daemon(size=(320, 180), calibration="vivid.yaml")
    health = stage.listener()
    began = now()
    health.flowing(began, 20, frames=5)
    for name in names(camera):
        time.sleep(0.5)
        before = health.last()
        began = now()
        done = name
        if name == "percentage_of_dropped_buffers":
            camera.set(name, 60)
            seen = health.wait(lambda r: "DROPPED_FRAMES" in r["errors"], 6, "DROPPED_FRAMES", began)
            camera.set(name, 0)
            done += " = 60"
        elif name == "disconnect":
            camera.set(name)
            seen = health.wait(lambda r: "NO_CAMERA" in r["errors"], 3, "NO_CAMERA", began)
            time.sleep(1)
            camera.unbind()
            camera.bind()
        else:
            camera.set(name)
            if name in AT_START or "setup" in name or "reqbufs" in name or "streamon" in name or "start" in name:
                camera.set("inject_fatal_streaming_error")
                done += ", then a broken stream"
            seen = None
        returned = now()
        frames = health.last()["frames_captured"]
        back = health.wait(lambda r: r["frames_captured"] > frames + 2 and not CAMERA_GONE & set(r["errors"]), 12, "frames flow", returned)
        recovery = back["t"] - returned
        check(daemon.alive(), f"{name}: the daemon ended")
        check(recovery < RETURN_LIMIT_S + 0.3, f"{name}: frames only after {recovery:.2f} s")
        note = f"{back['frames_corrupt'] - before['frames_corrupt']} corrupt, {back['frames_dropped'] - before['frames_dropped']} dropped"
        # A bit that stands for a second must be gone before the next injection.
        health.wait(lambda r: not r["errors"] or set(r["errors"]) <= {"LOW_FEATURES", "NO_FEATURES"}, 6, f"{name}: no fault left", back["t"])
        rows.append(row(health, began, f"vivid: {done}", recovery, note))
    began = now()
    camera.unbind()
    health.wait(lambda r: "NO_CAMERA" in r["errors"], 3, "NO_CAMERA", began)
    time.sleep(1)
    camera.bind()
    returned = now()
    back = health.flowing(returned - 0.2, 10)
    recovery = max(0.0, back["t"] - returned)
    check(recovery < RETURN_LIMIT_S, f"{recovery:.2f} s")
    rows.append(row(health, began, "vivid: driver unbound, bound again", recovery))
    return rows


SCENARIOS = {"vivid_injections": injections}
