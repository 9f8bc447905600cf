"""Planners other than our own `cairn watch`, for the kill rounds: the C and C++ examples, linked with libcairn.so, and the Python package.

Input: target/release/libcairn.so and clients/. Output in a folder that the guest sees: planner-c, planner-cpp, libcairn.so, and the package `cairn`
(iceoryx2 and numpy for it are in the guest's image).
"""

import pathlib
import shutil
import subprocess

ROOT = pathlib.Path(__file__).resolve().parent.parent.parent
LIBRARY = ROOT / "target/release/libcairn.so"


def demand():
    """Ends the program, before anything was started, when what `make` needs is not there."""
    if not LIBRARY.is_file():
        raise SystemExit(f"tests/vm: {LIBRARY} is not there: cargo rustc --release --lib --crate-type cdylib --features c")
    for compiler in "cc", "c++":
        if not shutil.which(compiler):
            raise SystemExit(f"tests/vm: there is no {compiler} here, for the planners in C and C++: apt-get install g++")


def make(folder):
    folder.mkdir()
    shutil.copy(LIBRARY, folder)
    subprocess.run(["strip", "--strip-debug", folder / LIBRARY.name], check=True)
    # The guest has the host's C library or a newer one (see image.release).
    link = ["-I", ROOT / "clients/c", "-L", folder, "-lcairn", "-Wl,-rpath,$ORIGIN"]
    for compiler, standard, name in [("cc", "-std=c11", "c"), ("c++", "-std=c++17", "cpp")]:
        subprocess.run([compiler, standard, "-O2", ROOT / f"clients/c/planner.{name}", *link, "-o", folder / f"planner-{name}"], check=True)
    shutil.copytree(ROOT / "clients/python/cairn", folder / "cairn", ignore=shutil.ignore_patterns("__pycache__"))
