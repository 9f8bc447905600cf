#!/usr/bin/env python3
"""What looking for old places and closing loops costs the poses: replays at the camera's pace with `[reconstruction] loops` and without, by turns.

    tests/results/loops.py ROUNDS RECORDING

`cairn` is looked for in PATH. Prints Markdown.
"""

import pathlib
import sys
import tempfile

sys.dont_write_bytecode = True
import paired  # noqa: E402


def main():
    rounds, recording = int(sys.argv[1]), sys.argv[2]
    with tempfile.TemporaryDirectory() as folder:
        log = f"{folder}/log"
        configs = {}
        for way, loops in {"without loops": "false", "with": "true"}.items():
            configs[way] = pathlib.Path(folder, f"{loops}.toml")
            configs[way].write_text(f"[reconstruction]\nloops = {loops}\n")
        runs = paired.rounds(list(configs), rounds, lambda way: paired.replay(way, recording, configs[way], log, {}))
        said = pathlib.Path(log).read_text()
        closed, tied = said.count("loop closed"), said.count("loop tied")
    base = runs["without loops"]
    rows = [[way, *paired.daemon_columns(told, base), "–" if told is base else paired.change("p99", told, base)] for way, told in runs.items()]
    paired.show(["", *paired.DAEMON_HEADS, "more, %"], rows)
    # The first replay of all is not counted, and has none.
    print(f"\n{closed} loops closed, and {tied} places more seen again where they should be, in {rounds} replays with them.")
    paired.tell_spread(base, "Without")


main()
