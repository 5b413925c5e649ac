"""Simulation-based calibration of `infer --scene` as a whole (Talts et al. 2018): scenes and images from the prior,
their posteriors, and the rank of each true number among its draws. Right posteriors give uniform ranks.

    python scripts/calibrate.py [PRIOR] [-n 500] [-o calibration.png] [--strict]

Prints a chi-square p-value for each number and writes the rank histograms; with --strict the exit status is 1 where a
right posterior would give such p-values once in a thousand times. Where all chains miss the mode that the truth is in,
the truth is often far more probable than every draw, and at the end of some histogram: both are counted.

Ranks need independent draws: of each number's draws as many are kept, evenly spaced, as they are worth by their
effective sample size. Angles that go all the way round have no smallest value: their ranks are taken from a place drawn
at random, the same for truth and draws.
"""

import argparse
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np  # noqa: E402
from arguments import at_least_one, target  # noqa: E402

from derender.cli import status_of  # noqa: E402
from derender.document import read_prior_document  # noqa: E402
from derender.posterior.sampler import Settings, read_settings  # noqa: E402
from derender.render.likelihoods import likelihoods  # noqa: E402
from derender.render.raycast.depth import render_depth  # noqa: E402
from derender.sampling.diagnostics import bulk_ess  # noqa: E402
from derender.structures.given import infer_scene, targets  # noqa: E402
from derender.structures.options import Options  # noqa: E402

BINS = 20
MOST_KEPT = 99  # draws that a rank is taken among
UNLIKELY = 1e-3  # of a right posterior to fail
MISSED = 5.0  # nats of the truth above every draw: they are of another mode


def ranks_of(document, settings: Settings, seed: int) -> tuple[tuple[str, ...], np.ndarray, float, float]:
    """Return the addresses, the normalised ranks of one drawn scene's numbers, the least effective sample size, and how
    many nats the truth is above the best draw."""
    rng = np.random.default_rng([17, seed])
    blank = np.zeros((document.camera.height, document.camera.width))
    target = targets(document, blank, document.camera, 0)[0][0]
    truth = target.space.sample(rng)
    numbers = {**target.images.values, **{
        a.removeprefix("likelihood."): v for a, v in target.by_address(truth).items() if a.startswith("likelihood.")
    }}  # fmt: skip
    depth = render_depth(target.graph(truth).solids(), document.camera)[0]
    image = likelihoods[document.likelihood.type].sample(rng, depth, numbers)
    part = infer_scene(document, image, document.camera, settings, Options(seed=seed)).posterior.parts[0]
    bound = targets(document, image, document.camera, 0)[0][0]
    above = bound.log_prior(truth) + bound.log_likelihood(truth) - part.log_density.max()
    ranks, least = [], np.inf
    for i, period in enumerate(part.periods):
        draws, true = part.values[:, :, i], truth[i]
        if period:
            cut = rng.uniform(0, period)
            draws, true = (draws - cut) % period, (true - cut) % period
        worth = bulk_ess(draws)
        least = min(least, worth)
        kept = draws.ravel()[:: max(1, int(np.ceil(draws.size / min(max(worth, 1.0), MOST_KEPT))))]
        ranks.append((np.sum(kept < true) + rng.random() * (1 + np.sum(kept == true))) / (len(kept) + 1))
    return part.addresses, np.array(ranks), least, float(above)


def p_value(ranks: np.ndarray) -> float:
    """Return the probability under uniform ranks of a chi-square as large as that of their histogram."""
    from scipy.stats import chi2

    counts, expected = np.histogram(ranks, BINS, (0, 1))[0], len(ranks) / BINS
    return float(chi2.sf(np.sum((counts - expected) ** 2) / expected, BINS - 1))


def draw(path: Path, addresses, ranks: np.ndarray, p_values) -> None:
    """Write the rank histograms, with the range that counts of uniform ranks seldom leave."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = 4
    rows = -(-len(addresses) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3 * columns, 2 * rows), squeeze=False, sharey=True)
    expected = len(ranks) / BINS
    for i, axis in enumerate(axes.ravel()):
        if i >= len(addresses):
            axis.axis("off")
            continue
        counts, edges = np.histogram(ranks[:, i], BINS, (0, 1))
        axis.bar(edges[:-1], counts, 1 / BINS, align="edge", color="#4477aa")
        axis.axhspan(expected - 3 * expected**0.5, expected + 3 * expected**0.5, color="0.8", zorder=0)
        axis.set_title(f"{addresses[i]}, p = {p_values[i]:.2f}", fontsize=8)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("prior", nargs="?", default="figure-4")
    parser.add_argument("-n", type=at_least_one, default=500)
    parser.add_argument("-o", type=target, default=Path("calibration.png"))
    parser.add_argument("--chains", type=at_least_one, default=2)
    parser.add_argument("--draws", type=at_least_one, default=250)
    parser.add_argument("--thin", type=at_least_one)
    parser.add_argument("--jobs", type=at_least_one, default=2)
    parser.add_argument("--strict", action="store_true")
    arguments = parser.parse_args()
    document = read_prior_document(arguments.prior)
    settings = read_settings(document.inference)
    settings = settings._replace(
        chains=arguments.chains, draws=arguments.draws, warmup=100, thin=arguments.thin or settings.thin
    )
    started = time.monotonic()
    with ProcessPoolExecutor(arguments.jobs) as pool:
        found = []
        for one in pool.map(partial(ranks_of, document, settings), range(arguments.n)):
            found.append(one)
            if len(found) % 25 == 0:
                print(f"{len(found)} scenes after {time.monotonic() - started:.0f} s", file=sys.stderr, flush=True)
    addresses = found[0][0]
    ranks = np.array([one[1] for one in found])
    least = np.array([one[2] for one in found])
    print(f"{arguments.n} scenes in {time.monotonic() - started:.0f} s; least effective sample size: median "
          f"{np.median(least):.0f}, under 50 in {np.mean(least < 50):.1%} of scenes")  # fmt: skip
    ends = np.sum((ranks < 1 / BINS) | (ranks > 1 - 1 / BINS))
    missed = sum(one[3] > MISSED for one in found)
    print(f"first and last bins hold {ends} of {ranks.size} ranks (right: {2 * ranks.size / BINS:.0f}); the truth is "
          f"{MISSED:g} nats above every draw in {missed} scenes")  # fmt: skip
    p_values = [p_value(ranks[:, i]) for i in range(len(addresses))]
    for address, p in zip(addresses, p_values, strict=True):
        print(f"{address:28} p = {p:.4f}")
    draw(arguments.o, addresses, ranks, p_values)
    print(f"wrote {arguments.o}")
    if arguments.strict and min(p_values) < UNLIKELY / len(p_values):
        sys.exit(f"not calibrated: p = {min(p_values):.2g} of {addresses[int(np.argmin(p_values))]}")


if __name__ == "__main__":
    sys.exit(status_of(main))
