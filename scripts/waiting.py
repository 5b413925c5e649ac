"""How long a person waits: whole processes of the command, warm and with no kernel compiled yet.

    python scripts/waiting.py [-n 5] [--only cubes --only tower]

Warm: the median over n images of each set of `scripts/evaluate.py` (all files and the report written), over n stacks of
three cubes, and over n runs of four chains of 2,000 draws on Figure 4; with --only over n images of these sets alone.
Cold: one run each with an empty folder for the kernels; what it takes more than the next run is compilation.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from arguments import at_least_one

from derender.cli import status_of
from derender.sampling.chains import SCENES, stream
from worlds.made_scenes import SETS, make_scene

WARM_SETS = ("settled", "noisy", "mixed", "tower", "cubes")


def seconds(folder, *arguments, **environment):
    """Return how long a whole `derender` process takes in a folder."""
    started = time.perf_counter()
    done = subprocess.run([sys.executable, "-m", "derender", *map(str, arguments)], cwd=folder, capture_output=True,
                          text=True, check=False, env={**os.environ, **environment})  # fmt: skip
    if done.returncode:
        raise SystemExit(f"derender {' '.join(map(str, arguments))}: {done.stderr.strip()}")
    return time.perf_counter() - started


def images(folder, name, count):
    """Write made images with their cameras; return the arguments of `infer` for each."""
    found = []
    for k in range(count):
        scene = make_scene(stream(k, SCENES, SETS.index(name)), name)
        image, camera = folder / f"{name}_{k}.npy", folder / f"{name}_{k}.json"
        np.save(image, scene["depth"])
        camera.write_text(json.dumps(scene["camera"].to_dict()))
        found.append(("infer", image, "--camera", camera, "-o", folder / "result"))
    return found


def row(name, found):
    """Print the median and the range of some runs."""
    print(f"| {name} | {np.median(found):.2f} | {min(found):.2f} to {max(found):.2f} |", flush=True)


def main() -> None:
    """Print the two tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-n", type=at_least_one, default=5)
    parser.add_argument("--only", action="append", choices=SETS, help="time inference on this set alone, warm")
    count, only = parser.parse_args().n, parser.parse_args().only
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sample = ("sample", "figure-4", "--seed", "1", "-o", "chains")
        chains = ("infer", "chains/sample_000.npz", "--scene", "figure-4", "--draws", "2000", "-o", "result")
        made = {each: images(folder, each, count) for each in only or WARM_SETS}
        print("| warm, whole process | median s | range |\n|---|---|---|")
        if only:
            for each in only:
                seconds(folder, *made[each][0])
                row(f"infer {each}", [seconds(folder, *one) for one in made[each]])
            return
        seconds(folder, *sample)
        for each in (made["settled"][0], chains):
            seconds(folder, *each)  # compiles what is not compiled yet
        row("--help", [seconds(folder, "--help") for _ in range(count)])
        for each in WARM_SETS:
            row(f"infer {each}", [seconds(folder, *one) for one in made[each]])
        row("infer --scene", [seconds(folder, *chains) for _ in range(count)])
        print("\n| cold, whole process | s | more than warm |\n|---|---|---|")
        commands = {"sample": sample, "score": ("score", "chains/sample_000.yaml", "chains/sample_000.npz"),
                    "infer": made["settled"][0], "infer --scene": chains}  # fmt: skip
        for label, command in commands.items():
            with tempfile.TemporaryDirectory() as empty:
                cold, warm = (seconds(folder, *command, NUMBA_CACHE_DIR=empty) for _ in range(2))
            print(f"| {label} | {cold:.1f} | {cold - warm:.1f} |", flush=True)


if __name__ == "__main__":
    sys.exit(status_of(main))
