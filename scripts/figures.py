"""Draw the paper's figures from our own runs, our numbers beside the paper's: `make figures`.

python scripts/figures.py [--out figures] [--only 1 2 3 4 5] [--seed 1]
"""

import argparse
import os
import sys
import time
from pathlib import Path

from derender.cli import status_of

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import figure_inference  # noqa: E402
import figure_scenes  # noqa: E402
import matplotlib  # noqa: E402

FIGURES = {
    1: figure_scenes.figure_1,
    2: figure_scenes.figure_2,
    3: figure_scenes.figure_3,
    4: figure_inference.figure_4,
    5: figure_inference.figure_5,
}


def main() -> None:
    """Draw the figures asked for and print the table of numbers."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder for the pictures")
    parser.add_argument("--only", type=int, nargs="*", choices=sorted(FIGURES), default=sorted(FIGURES))
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    matplotlib.use("Agg")
    arguments.out.mkdir(parents=True, exist_ok=True)
    for number in arguments.only:
        start = time.perf_counter()
        path = arguments.out / f"figure_{number}.png"
        rows = FIGURES[number](path, arguments.seed)
        print(f"Figure {number}: {path} ({time.perf_counter() - start:.1f} s)")
        width = max(len(what) for what, _, _ in rows)
        for what, ours, paper in rows:
            print(f"  {what.ljust(width)}  ours {ours}  paper {paper}")


if __name__ == "__main__":
    sys.exit(status_of(main))
