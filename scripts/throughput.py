"""Measure many frames: frames a second with one process and with two, the best scene only and whole posteriors.

    python scripts/throughput.py                40 frames of the set `settled` at 160 x 120
    python scripts/throughput.py -n 200

Times are of `derender infer FRAMES` as a user runs it, files included; report pages are made on demand. Start-up is
what one frame for each process takes, the same one: a frame takes .1 to 5 s, so that others would be no match for those
beyond them, of which the figures are. CPU seconds are those of all processes: on a busy machine they tell more than the
wall clock. Of few frames the last ones, which one process works on alone, weigh: take a hundred to compare processes.
"""

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from arguments import at_least_one

from derender.camera.depth_file import write_depth
from derender.cli import status_of
from worlds.made_scenes import SETS, make_scene


def write_frames(folder, count):
    """Write frames of the set `settled`; return their folder."""
    for number in range(count):
        scene = make_scene(np.random.default_rng([number, SETS.index("settled")]), "settled")
        write_depth(folder / f"frame_{number:04d}.npz", scene["depth"], scene["camera"])
    return f"{scene['camera'].width} x {scene['camera'].height}"


def run(frames, output, *options):
    """Infer frames; return (wall, CPU) seconds."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "derender", "infer", *map(str, frames), "-q", "-o", str(output), *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return np.array([time.perf_counter() - started, cpu])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=at_least_one, default=40, help="frames, more than processes")
    parser.add_argument("--processes", type=at_least_one, nargs="+", default=[1, 2])
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        frames = Path(place) / "frames"
        frames.mkdir()
        size = write_frames(frames, arguments.n)
        print(f"{arguments.n} frames of {size} pixels; load of the machine {os.getloadavg()[0]:.1f}")
        head = "| mode | processes | first frames, s | further frames a second | CPU s each | times one process |"
        print(head + "\n" + "|---" * 6 + "|")
        images = sorted(frames.iterdir())
        for mode, options in (("--quick", ["--quick"]), ("whole", [])):
            run(images[:1], Path(place) / f"{mode}_warm", *options, "-j", "1")
            one = None
            for processes in arguments.processes:
                first = [Path(place) / f"{k}.npz" for k in range(processes)]
                for path in first:
                    shutil.copy(images[0], path)
                few, all_of_them = (
                    run(some, Path(place) / f"{mode}_{processes}_{len(some)}", *options, "-j", str(processes))
                    for some in (first, images)
                )
                wall, cpu = (all_of_them - few) / (len(images) - processes)
                one = one or wall
                figures = f"{few[0]:.1f} | {1.0 / wall:.2f} | {cpu:.3f} | {one / wall:.2f}"
                print(f"| {mode} | {processes} | {figures} |", flush=True)


if __name__ == "__main__":
    sys.exit(status_of(main))
