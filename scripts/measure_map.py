"""Measure Figure 5's ascents on random scenes: ten random starts each, both methods. One table on stdout."""

import argparse
import sys
import time

import numpy as np

from derender import data_path
from derender.cli import status_of
from derender.document import read_document
from derender.posterior.forward import draw_documents, observe
from derender.posterior.map import MapProblem
from derender.render.raycast.depth import render_depth
from derender.report.contents import likelihood_numbers

ADDRESSES = ("yellow.contact.theta", "yellow.contact.u", "yellow.contact.v")
REACHED = 3.0  # nats below the truth that count as the truth


def ascents(scenes: int, starts: int, seed: int, method: str, iterations: int) -> dict[str, str]:
    """Ascend from random starts on random scenes of Figure 5 and return what Figure 5 is judged by."""
    document = read_document(data_path("priors/figure-5.yaml"))
    best, single, steps, times, climbed = [], [], [], [], []
    for draw in draw_documents(document, scenes, seed, {}):
        clean, _ = render_depth(draw.graph.solids(), draw.camera, antialias=16, background=10.0)
        depth = observe(draw.rng, clean, draw.likelihood)
        values = likelihood_numbers(draw.likelihood)
        sigma, blur = values["sigma"], values["blur"]
        problem = MapProblem(draw.graph, ADDRESSES, draw.camera, depth, sigma=sigma, blur=blur)
        truth = problem.log_density(problem.values)
        places = problem.random_starts(draw.rng, starts)
        begin = time.perf_counter()
        found = problem.maximise(places, method, iterations=iterations)
        times.append(time.perf_counter() - begin)
        good = [maximum.log_density > truth - REACHED for maximum in found]
        best.append(any(good))
        single.append(np.mean(good))
        climbed += [(m.log_density - m.log_densities[0]) / (truth - m.log_densities[0]) for m in found]
        steps += [maximum.iterations for maximum, right in zip(found, good, strict=True) if right]
    return {
        "best start reaches the truth": f"{100 * np.mean(best):.0f} of 100 scenes",
        "a single start does": f"{100 * np.mean(single):.0f} of 100",
        "share of the climb, median": f"{np.median(climbed):.2f}",
        "iterations, median": f"{np.median(steps) if steps else np.nan:g}",
        f"{starts} starts, median": f"{1e3 * np.median(times[1:]):.0f} ms",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=100)
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for method, iterations in (("gauss-newton", 12), ("gradient", 12)):
        print(f"{method}, at most {iterations} steps at full resolution")
        for name, value in ascents(options.scenes, options.starts, options.seed, method, iterations).items():
            print(f"    {name:32s}{value}")


if __name__ == "__main__":
    sys.exit(status_of(main))
