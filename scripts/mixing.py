"""Measure how fast chains learn: on towers drawn as in Figure 4, and in Metropolis-Hastings steps a second.

    python scripts/mixing.py [-n 100] [--thin 30]

Prints the R-hat of every scene, the effective samples a second of the default mixture beside those of resimulation
alone (the paper's kernel) on one scene in the same run, and steps a second on a plane with four boxes, for one chain
alone and for two processes at once. Times are wall clock and processor time: other work on the machine shows in one.
"""

import argparse
import multiprocessing
import os
import sys
import time

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402
from arguments import at_least_one  # noqa: E402

from derender.cli import status_of  # noqa: E402
from derender.document import document_from, read_prior_document  # noqa: E402
from derender.posterior.compiled.backend import backend_of  # noqa: E402
from derender.posterior.kernels import mixture  # noqa: E402
from derender.posterior.kernels.base import first_tuning  # noqa: E402
from derender.posterior.sampler import read_settings  # noqa: E402
from derender.render.likelihoods import likelihoods  # noqa: E402
from derender.render.raycast.depth import render_depth  # noqa: E402
from derender.sampling.diagnostics import bulk_ess, r_hat, unwrap  # noqa: E402
from derender.scene.codec.yaml_tree import parse_yaml  # noqa: E402
from derender.structures.given import infer_scene, targets  # noqa: E402
from derender.structures.options import Options  # noqa: E402

BOX = """
  box_{k}:
    shape: {{type: box, length: 0.1, width: 0.08, height: 0.07}}
    parent: floor
    contact: {{type: face-to-face, theta: {{uniform: [0, 180 deg]}}, x: {{normal: [{x}, 0.01]}}, y: {{normal: [{y}, 0.01]}}}}
"""  # noqa: E501


def drawn(document, seed: int):
    """Return a noisy image of a scene drawn from the document's prior, and its values."""
    rng = np.random.default_rng([17, seed])
    blank = np.zeros((document.camera.height, document.camera.width))
    target = targets(document, blank, document.camera, 0)[0][0]
    truth = target.space.sample(rng)
    depth = render_depth(target.graph(truth).solids(), document.camera)[0]
    return likelihoods[document.likelihood.type].sample(rng, depth, target.images.values), truth


def measured(document, settings, seed: int) -> tuple[float, str, float, float, float]:
    """Return worst R-hat, its address, least effective sample size, wall and processor seconds of one inference."""
    image, _ = drawn(document, seed)
    wall, processor = time.perf_counter(), time.process_time()
    part = infer_scene(document, image, document.camera, settings, Options(seed=seed, jobs=2)).posterior.parts[0]
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    draws = [unwrap(part.values[:, :, i], period) for i, period in enumerate(part.periods)]
    values = [r_hat(one) for one in draws]
    worst = int(np.argmax(values))
    return values[worst], part.addresses[worst], min(map(bulk_ess, draws)), wall, processor


def boxes_document(width: int, height: int):
    """Return the document of a plane and four boxes whose contacts are unknown."""
    text = (
        f"derender: 1\ncamera: {{fx: {0.95 * width}, fy: {0.95 * width}, cx: {(width - 1) / 2}, "
        f"cy: {(height - 1) / 2}, width: {width}, height: {height}}}\n"
        "root: {distance: 0.8, elevation: 35 deg}\nobjects:\n  floor: {shape: plane, contact: {type: 6dof}}\n"
        + "".join(BOX.format(k=k, x=0.16 * (k % 2) - 0.08, y=0.16 * (k // 2) - 0.08) for k in range(4))
        + "likelihood: {type: gaussian, sigma: 0.005, blur: 1.0}\n"
    )
    from pathlib import Path

    return document_from(parse_yaml(text.encode(), "boxes"), Path("."))


def steps_a_second(size: tuple[int, int]) -> float:
    """Return Metropolis-Hastings steps a second of a chain with a drift kernel, the median of five stretches."""
    document = boxes_document(*size)
    image, truth = drawn(document, 0)
    target = targets(document, image, document.camera, 0)[0][0]
    backend = backend_of(target, mixture(target.space, [{"drift": {}}]))
    tuning = first_tuning(target.space, truth)
    rng = np.random.default_rng(0)
    backend.sweep(rng, truth, tuning, 1, 1000)
    rates = []
    for _ in range(5):
        started = time.perf_counter()
        backend.sweep(rng, truth, tuning, 1, 50_000)
        rates.append(50_000 / (time.perf_counter() - started))
    return float(np.median(rates))


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-n", type=at_least_one, default=20, help="towers")
    parser.add_argument("--first", type=int, default=0, help="number of the first tower")
    parser.add_argument("--thin", type=at_least_one, default=30)
    arguments = parser.parse_args()
    for size in ((64, 64), (160, 120)):
        alone = steps_a_second(size)
        with multiprocessing.get_context("spawn").Pool(2) as pool:
            two = sum(pool.map(steps_a_second, [size, size], chunksize=1))
        print(f"{size[0]}x{size[1]}: {alone:,.0f} drift steps a second, two processes {two / alone:.2f} times as many")
    document = read_prior_document("figure-4")
    settings = read_settings(document.inference)._replace(draws=2000, warmup=200, thin=arguments.thin)
    measured(document, settings._replace(draws=10, warmup=10), 0)  # compiles
    _, _, ours, wall, processor = measured(document, settings, 0)
    plain = settings._replace(kernels=[{"resimulate": {}}], population=1, warmup=20)
    _, _, theirs, _, paper = measured(document, plain, 0)
    print(f"effective samples a second (processor time): {ours / processor:.1f}, resimulation {theirs / paper:.2f}, "
          f"{ours / processor / (theirs / paper):.0f} times")  # fmt: skip
    good = 0
    for seed in range(arguments.first, arguments.first + arguments.n):
        value, address, least, wall, processor = measured(document, settings, seed)
        good += value < 1.01
        print(f"tower {seed:3d}: R-hat {value:.4f} ({address}), least ESS {least:5.0f}, {wall:.1f} s, "
              f"processor {processor:.1f} s", flush=True)  # fmt: skip
    print(f"R-hat < 1.01 in {good} of {arguments.n} towers")


if __name__ == "__main__":
    sys.exit(status_of(main))
