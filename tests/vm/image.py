"""The guest's disk, kernel and initramfs: a small Debian, built once and kept outside the checkout's tracked files.

Input: a folder. Output in it: `vmlinux`, `initrd`, `root.img`, and `key`, a digest of this file and of the host's
Debian release, by which a later call knows that there is nothing to do. Needs root, apt's network, and the packages
of `HOST_PACKAGES`. About a minute and a half, 1.5 GB.
"""

import hashlib
import lzma
import os
import pathlib
import re
import shutil
import subprocess
import tempfile
import zipfile

HOST_PACKAGES = {  # program that shows that it is there: Debian's package
    "qemu-system-x86_64": "qemu-system-x86",
    "mmdebstrap": "mmdebstrap",
    "mke2fs": "e2fsprogs",
    "cpio": "cpio",
}
GUEST_PACKAGES = "systemd systemd-sysv udev kmod procps python3 v4l-utils busybox-static passwd util-linux python3-numpy".split()
# For the Python planner: the wheel that clients/python asks for, and what that asks for. Our own code comes from the host at every boot.
GUEST_WHEEL = "iceoryx2==0.10.0"
# Enough to mount the disk; everything else is loaded by udev or by the scenarios.
EARLY_MODULES = ["virtio_pci", "virtio_blk", "ext4", "crc32c_generic"]
IDLE_UNITS = [  # they cost seconds on an emulated processor, and no scenario needs them
    "apt-daily.timer", "apt-daily-upgrade.timer", "dpkg-db-backup.timer", "e2scrub_all.timer", "e2scrub_reap.service",
    "fstrim.timer", "getty@tty1.service", "systemd-timesyncd.service", "systemd-networkd.service",
    "systemd-networkd.socket", "systemd-binfmt.service", "modprobe@drm.service", "modprobe@fuse.service",
    "modprobe@loop.service", "modprobe@dm_mod.service", "modprobe@efi_pstore.service", "sys-fs-fuse-connections.mount",
    "proc-sys-fs-binfmt_misc.automount", "systemd-firstboot.service", "systemd-pstore.service",
]

EARLY_INIT = r"""#!/bin/busybox sh
/bin/busybox mkdir -p /proc /dev /new
/bin/busybox mount -t proc none /proc
/bin/busybox mount -t devtmpfs none /dev
if /bin/busybox grep -q cairn.probe /proc/cmdline; then
    echo cairn-probe-alive > /dev/console
    /bin/busybox poweroff -f
fi
for module in $(/bin/busybox cat /modules/list); do /bin/busybox insmod /modules/$module; done
n=0
while [ ! -b /dev/vda ] && [ $n -lt 200 ]; do n=$((n + 1)); /bin/busybox sleep 0.05; done
/bin/busybox mount -t ext4 -o noatime /dev/vda /new || /bin/busybox poweroff -f
/bin/busybox mount --move /dev /new/dev
/bin/busybox umount /proc
exec /bin/busybox switch_root /new /lib/systemd/systemd
"""

# The scenarios come from the host at every boot; a boot that finds no host powers off.
START = r"""#!/bin/sh
modprobe -a 9pnet_virtio 9p
mkdir -p /mnt/stage /mnt/out
mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144,cache=loose,ro stage /mnt/stage &&
mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144,cache=none out /mnt/out &&
exec python3 -u /mnt/stage/guest/job.py >> /mnt/out/log.txt 2>&1
systemctl poweroff -ff
"""

FILES = {
    "usr/local/sbin/cairn-vm": START,
    "etc/systemd/system/cairn-vm.service": """[Unit]
Description=Scenarios of the host
After=systemd-udevd.service systemd-udev-trigger.service systemd-tmpfiles-setup.service
[Service]
ExecStart=/usr/local/sbin/cairn-vm
TimeoutStopSec=3
SendSIGHUP=no
[Install]
WantedBy=multi-user.target
""",
    "etc/systemd/journald.conf.d/vm.conf": "[Journal]\nStorage=persistent\nSystemMaxUse=64M\n",
    # What the scenarios kill is not worth a wait of 90 s.
    "etc/systemd/system.conf.d/vm.conf": "[Manager]\nDefaultTimeoutStopSec=10s\n",
    "etc/modprobe.d/vm.conf": "".join(f"blacklist {m}\n" for m in "i2c_i801 iTCO_wdt lpc_ich pcspkr psmouse".split()),
    "etc/hostname": "robot\n",
    "etc/hosts": "127.0.0.1 localhost robot\n",
    "etc/fstab": "",
    "etc/machine-id": hashlib.md5(b"cairn-vm").hexdigest() + "\n",
}


def run(*words, log, **options):
    """A program whose output goes to the log; its failure is ours."""
    log.write(f"$ {' '.join(map(str, words))}\n")
    log.flush()
    done = subprocess.run([str(w) for w in words], stdin=subprocess.DEVNULL, stdout=log, stderr=log, **options)
    if done.returncode:
        raise SystemExit(f"tests/vm: {words[0]} ended with {done.returncode}, see {log.name}")


def release():
    """The host's Debian release: the guest's libraries must not be older than those that the binary was linked with."""
    names = dict(re.findall(r'^(\w+)="?([^"\n]*)', pathlib.Path("/etc/os-release").read_text(), re.M))
    return names.get("VERSION_CODENAME", "bookworm") if names.get("ID") == "debian" else "trixie"


def install_host_packages():
    missing = [package for program, package in HOST_PACKAGES.items() if not shutil.which(program)]
    have_pil = subprocess.run(["/usr/bin/python3", "-c", "import PIL"], stderr=subprocess.DEVNULL).returncode == 0
    if not have_pil:
        missing.append("python3-pil")
    if subprocess.run(["/usr/bin/python3", "-c", "import venv, ensurepip"], stderr=subprocess.DEVNULL).returncode:
        missing.append("python3-venv")
    if not missing:
        return
    if os.geteuid() != 0:
        raise SystemExit(f"tests/vm: needs root and: apt-get install --no-install-recommends {' '.join(missing)}")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for words in (["update", "-q"], ["install", "-qy", "--no-install-recommends", *missing]):
        subprocess.run(["apt-get", *words], check=True, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                       env=environment)


def build(folder):
    """Builds the image unless it is there. Returns whether it had to be built."""
    suite = release()
    key = hashlib.sha256(pathlib.Path(__file__).read_bytes() + suite.encode()).hexdigest()
    stamp = folder / "key"
    if stamp.exists() and stamp.read_text() == key:
        return False
    stamp.unlink(missing_ok=True)
    folder.mkdir(parents=True, exist_ok=True)
    work = pathlib.Path(tempfile.mkdtemp(prefix="build-", dir=folder))
    try:
        with open(folder / "build.log", "w", encoding="utf-8") as log:
            root = work / "root"
            run("mmdebstrap", "--mode=root", "--variant=minbase", "--skip=cleanup/apt", "--format=directory",
                "--dpkgopt=path-exclude=/usr/share/doc/*", "--dpkgopt=path-exclude=/usr/share/locale/*",
                "--dpkgopt=path-exclude=/usr/share/man/*", "--dpkgopt=force-unsafe-io",
                f"--include={','.join(GUEST_PACKAGES)}", suite, root, log=log)
            version = add_kernel(root, log)
            configure(root)
            add_wheels(work, root, log)
            (folder / "vmlinux").write_bytes(unpacked((root / f"boot/vmlinuz-{version}").read_bytes()))
            add_initramfs(work, root, version, folder / "initrd", log)
            shutil.rmtree(root / "var/lib/apt/lists", ignore_errors=True)
            shutil.rmtree(root / "var/cache/apt", ignore_errors=True)
            (folder / "root.img").unlink(missing_ok=True)
            run("mke2fs", "-q", "-t", "ext4", "-d", root, folder / "root.img", "2G", log=log)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    (folder / "accelerator").unlink(missing_ok=True)
    stamp.write_text(key)
    return True


def add_kernel(root, log):
    """Debian's own kernel with all its modules, without the initramfs tools that its package asks for."""
    script = """set -e
cd /tmp
name=$(apt-cache depends --important linux-image-amd64 | sed -n 's/.*Depends: *\\(linux-image-[0-9]\\)/\\1/p' | head -n1)
apt-get download -q "$name"
mv linux-image-*.deb kernel.deb
"""
    run("chroot", root, "sh", "-c", script, log=log)
    # A root with merged /usr has /lib as a link, which must stay one.
    run("sh", "-c", f"dpkg-deb --fsys-tarfile {root}/tmp/kernel.deb | tar -x --keep-directory-symlink -C {root}", log=log)
    (root / "tmp/kernel.deb").unlink()
    version = next((root / "boot").glob("vmlinuz-*")).name.removeprefix("vmlinuz-")
    run("chroot", root, "depmod", version, log=log)
    return version


def add_wheels(work, root, log):
    """A wheel is a zip archive of what lies in site-packages; pip only fetches it, so that the guest needs no pip."""
    run("/usr/bin/python3", "-m", "venv", work / "venv", log=log)
    run(work / "venv/bin/pip", "download", "--only-binary=:all:", "--disable-pip-version-check", "--dest", work / "wheel",
        GUEST_WHEEL, log=log)
    for path in (work / "wheel").glob("*.whl"):
        with zipfile.ZipFile(path) as wheel:
            wheel.extractall(root / "usr/lib/python3/dist-packages")
    # Once here, and not at every start on an emulated processor.
    run("chroot", root, "python3", "-m", "compileall", "-q", "/usr/lib/python3/dist-packages", log=log)


def configure(root):
    for name, text in FILES.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        path.write_text(text)
    (root / "usr/local/sbin/cairn-vm").chmod(0o755)
    units = root / "etc/systemd/system"
    for unit in IDLE_UNITS:
        (units / unit).unlink(missing_ok=True)
        (units / unit).symlink_to("/dev/null")
    wants = units / "multi-user.target.wants"
    wants.mkdir(exist_ok=True)
    (wants / "cairn-vm.service").symlink_to("/etc/systemd/system/cairn-vm.service")


def unpacked(kernel):
    """The kernel without its xz wrapping, which an emulated processor would take seconds over."""
    start = kernel.find(b"\xfd7zXZ\x00")
    if start < 0:
        return kernel
    inner = lzma.LZMADecompressor().decompress(kernel[start:])
    return inner if inner.startswith(b"\x7fELF") else kernel


def add_initramfs(work, root, version, target, log):
    tree = work / "early"
    (tree / "bin").mkdir(parents=True)
    (tree / "modules").mkdir()
    shutil.copy(root / "bin/busybox", tree / "bin/busybox")
    (tree / "init").write_text(EARLY_INIT)
    (tree / "init").chmod(0o755)
    order = []
    for module in EARLY_MODULES:
        listing = subprocess.run(["chroot", root, "modprobe", "-S", version, "--show-depends", module],
                                 check=True, capture_output=True, text=True).stdout
        for path in re.findall(r"^insmod (\S+)", listing, re.M):
            name = pathlib.Path(path).name
            if name not in order:
                order.append(name)
                shutil.copy(root / path.lstrip("/"), tree / "modules")
    (tree / "modules/list").write_text("\n".join(order) + "\n")
    run("sh", "-c", f"find . | cpio --quiet -o -H newc > '{target}'", cwd=tree, log=log)
