"""Simulation-based calibration of `infer --scene` as a whole (Talts et al. 2018): scenes and images from the prior,
their posteriors, and the rank of each true number among its draws. Right posteriors give uniform ranks.

    python scripts/calibrate.py [PRIOR] [-n 500] [-o calibration.png]

Prints a chi-square p-value for each number and writes the rank histograms. Angles that go all the way round have no
smallest value: their ranks are taken from a place drawn at random, the same for truth and draws.
"""

import argparse
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from derender.document import read_prior_document
from derender.inference.diagnostics import bulk_ess
from derender.inference.scene import infer_scene, targets
from derender.inference.settings import Settings, read_settings
from derender.vision.likelihoods import likelihoods
from derender.vision.raycast.depth import render_depth

BINS = 20


def ranks_of(document, settings: Settings, seed: int) -> tuple[tuple[str, ...], np.ndarray, float]:
    """Return the addresses, the normalised ranks of one drawn scene's numbers, and the least effective sample size."""
    rng = np.random.default_rng([17, seed])
    blank = np.zeros((document.camera.height, document.camera.width))
    target = targets(document, blank, document.camera, 0)[0][0]
    truth = target.space.sample(rng)
    numbers = {**target.images.values, **{
        a.removeprefix("likelihood."): v for a, v in target.by_address(truth).items() if a.startswith("likelihood.")
    }}  # fmt: skip
    depth = render_depth(target.graph(truth).solids(), document.camera)[0]
    image = likelihoods[document.likelihood.type].sample(rng, depth, numbers)
    part = infer_scene(document, image, document.camera, settings, seed=seed).posterior.parts[0]
    ranks, least = [], np.inf
    for i, period in enumerate(part.periods):
        draws, true = part.values[:, :, i], truth[i]
        if period:
            cut = rng.uniform(0, period)
            draws, true = (draws - cut) % period, (true - cut) % period
        least = min(least, bulk_ess(draws))
        kept = draws[:, :: max(1, draws.shape[1] // 50)].ravel()
        ranks.append((np.sum(kept < true) + rng.random() * (1 + np.sum(kept == true))) / (len(kept) + 1))
    return part.addresses, np.array(ranks), least


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("prior", nargs="?", default="figure-4")
    parser.add_argument("-n", type=int, default=500)
    parser.add_argument("-o", default="calibration.png")
    parser.add_argument("--thin", type=int)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    document = read_prior_document(arguments.prior)
    settings = read_settings(document.inference)
    settings = settings._replace(draws=500, thin=arguments.thin or settings.thin)
    started = time.monotonic()
    with ThreadPoolExecutor(arguments.jobs) as pool:
        found = list(pool.map(lambda seed: ranks_of(document, settings, seed), range(arguments.n)))
    addresses = found[0][0]
    ranks = np.array([one[1] for one in found])
    print(f"{arguments.n} scenes in {time.monotonic() - started:.0f} s; median of the least ESS "
          f"{np.median([one[2] for one in found]):.0f}")  # fmt: skip
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from scipy.stats import chi2

    columns = 4
    rows = -(-len(addresses) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(3 * columns, 2 * rows), squeeze=False, sharey=True)
    expected = arguments.n / BINS
    for i, axis in enumerate(axes.ravel()):
        if i >= len(addresses):
            axis.axis("off")
            continue
        counts, edges = np.histogram(ranks[:, i], BINS, (0, 1))
        p = chi2.sf(np.sum((counts - expected) ** 2) / expected, BINS - 1)
        print(f"{addresses[i]:28} p = {p:.3f}")
        axis.bar(edges[:-1], counts, 1 / BINS, align="edge", color="#4477aa")
        axis.axhspan(expected - 3 * expected**0.5, expected + 3 * expected**0.5, color="0.8", zorder=0)
        axis.set_title(f"{addresses[i]}, p = {p:.2f}", fontsize=8)
    figure.tight_layout()
    figure.savefig(arguments.o, dpi=120)
    print(f"wrote {arguments.o}")


if __name__ == "__main__":
    main()
