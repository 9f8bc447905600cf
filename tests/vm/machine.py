"""One run of the guest: boots it, waits for it to switch itself off, and says how that went.

Shares two folders with it: `stage` (read-only: binary, frames, scenarios, job.json) and `out` (what the scenarios report). The
disk's changes are thrown away at the end but survive a reboot of the guest, as a power cut must show.
"""

import pathlib
import subprocess
import time

KERNEL_WORDS = ("console=ttyS0 quiet panic=-1 mitigations=off nokaslr tsc=reliable no_timer_check audit=0 "
                "random.trust_cpu=on systemd.show_status=no net.ifnames=0")


def words(image, accelerator, memory_mb):
    if accelerator == "kvm":
        speed = ["-accel", "kvm", "-cpu", "host"]
    else:
        # One instruction is one nanosecond of the guest's clock: a busy host makes the guest slow to wait for and not slow by
        # its own clock, which is what everything is measured with.
        speed = ["-accel", "tcg,thread=single,tb-size=512", "-icount", "shift=0", "-cpu", "Nehalem"]
    return ["qemu-system-x86_64", *speed, "-machine", "q35,hpet=off,sata=off,smbus=off", "-smp", "1", "-m", str(memory_mb),
            "-nodefaults", "-no-user-config", "-display", "none", "-nic", "none",
            "-kernel", str(image / "vmlinux"), "-initrd", str(image / "initrd")]


def accelerator(image):
    """kvm where a kernel really starts under it (that /dev/kvm can be opened does not say so), else tcg."""
    known = image / "accelerator"
    if not known.exists():
        probe = words(image, "kvm", 256) + ["-append", KERNEL_WORDS + " cairn.probe", "-serial", "stdio", "-no-reboot"]
        try:
            done = subprocess.run(probe, timeout=15, stdin=subprocess.DEVNULL, capture_output=True)
            alive = b"cairn-probe-alive" in done.stdout
        except subprocess.TimeoutExpired:
            alive = False
        known.write_text("kvm" if alive else "tcg")
    return known.read_text()


def boot(image, stage, out, limit_s, watch):
    """Runs the guest for at most `limit_s` seconds of ours; `watch` is called twice a second. The reason why it ended:
    `off`, `panic`, `time`."""
    console = out / "console.txt"
    disk = f"file={image}/root.img,if=none,id=disk,format=raw,snapshot=on,cache=unsafe"
    command = words(image, accelerator(image), 1536) + [
        "-append", KERNEL_WORDS, "-serial", f"file:{console}",
        "-drive", disk, "-device", "virtio-blk-pci,drive=disk", "-device", "virtio-rng-pci",
        "-virtfs", f"local,path={stage},mount_tag=stage,security_model=none,readonly=on",
        "-virtfs", f"local,path={out},mount_tag=out,security_model=none"]
    end = time.monotonic() + limit_s
    with open(out / "qemu.txt", "ab") as errors:
        guest = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=errors, stderr=errors)
        try:
            while time.monotonic() < end:
                try:
                    guest.wait(timeout=0.5)
                    return "off"
                except subprocess.TimeoutExpired:
                    watch()
                if console.exists() and b"Kernel panic - not syncing" in tail(console):
                    return "panic"
            return "time"
        finally:
            if guest.poll() is None:
                guest.kill()
                guest.wait()


def tail(path: pathlib.Path):
    with open(path, "rb") as file:
        file.seek(max(0, path.stat().st_size - 16384))
        return file.read()
