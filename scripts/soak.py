"""Send many frames through one process, as `derender infer FRAMES` does, and watch its memory and its open files.

    python scripts/soak.py                2,000 frames of 64 x 48 pixels, the best scene only
    python scripts/soak.py -n 200 --whole

Every 100 frames a line tells the resident memory and the open files. Exits with 1 where the memory at the end is more
than 5 % above that after the first fifth of the frames, by when everything has been loaded, or where files stay open.
"""

import argparse
import gc
import itertools
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

from arguments import at_least_one

import derender
from derender.batch.frames import Frame, Order, infer_frame
from derender.camera.depth_file import write_depth
from derender.cli import status_of
from derender.compilation.threads import THREADS_VARIABLE
from derender.structures.options import Options

DIFFERENT = 20  # frames, which come again and again
EVERY, SETTLED, GROWTH = 100, 0.2, 1.05
CAMERA = derender.Camera.from_field_of_view(64, 48)


def resident():
    """Return this process's resident memory in MiB."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def open_files():
    """Return how many files this process has open."""
    return len(os.listdir("/proc/self/fd"))


def write_frames(folder):
    """Write frames of scenes drawn from `tabletop`, and of a plane alone; return their paths."""
    paths = []
    for seed in range(DIFFERENT):
        path = folder / f"frame_{seed:02d}.npz"
        write_depth(path, *derender.sample("tabletop", seed=seed, camera=CAMERA).render(noise=True, seed=seed)[:2])
        paths.append(path)
    return paths


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=at_least_one, default=2000, help="frames")
    parser.add_argument("--whole", action="store_true", help="whole posteriors, not the best scene only")
    arguments = parser.parse_args()
    os.environ[THREADS_VARIABLE] = "1"
    order = Order(Options(seed=0) if arguments.whole else Options(seed=0, method="map", quick=True))
    first, started, failed = {}, time.monotonic(), 0
    with tempfile.TemporaryDirectory() as place:
        paths = write_frames(Path(place))
        output = Path(place) / "out"
        print("| frames | seconds | memory, MiB | open files |\n|---|---|---|---|")
        for number, path in zip(range(1, arguments.n + 1), itertools.cycle(paths)):
            done = infer_frame(Frame(f"{number}", str(path)), order, str(output))
            failed += bool(done.error)
            shutil.rmtree(output / done.frame.name, ignore_errors=True)
            if number % EVERY == 0 or number == arguments.n:
                gc.collect()
                now = {"memory": resident(), "files": open_files()}
                if not first and number >= SETTLED * arguments.n:
                    first = now
                row = f"| {number} | {time.monotonic() - started:.0f} | {now['memory']:.1f} | {now['files']} |"
                print(row, flush=True)
    grown = now["memory"] / first["memory"]
    print(f"{failed} frames failed; memory at the end {grown:.3f} times that after a fifth of the frames")
    return 1 if failed or grown > GROWTH or now["files"] > first["files"] else 0


if __name__ == "__main__":
    sys.exit(status_of(main))
