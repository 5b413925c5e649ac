"""Parts of a posterior: draws of the unknown numbers of one structure, and what all of its objects may be."""

import math
import time
from typing import Any

import numpy as np

from derender.posterior.kernels.base import Part
from derender.posterior.target import SceneTarget
from derender.results.posterior import StructurePosterior
from derender.results.trust import LIMITS, QUICK_LIMITS, doubtful, enough_draws, misleads
from derender.sampling import diagnostics
from derender.sampling.chains import Outcome, Plan, Progress, Record, run_chains


def silent(chain: int, steps: int, most: int) -> None:
    """Tell nobody of progress."""


LEAST_LIKELY, MOST_STRUCTURES = 1e-3, 24  # share of the likeliest's weight that one told has; how many, at most


def part_of(target: SceneTarget, records: list[Record], mixed: list[Part]) -> StructurePosterior | None:
    """Return the draws of several chains as one rectangle, cut where that keeps the most; None without any draw."""
    counts = sorted((record.drawn for record in records), reverse=True)
    kept = max(range(len(counts)), key=lambda k: (k + 1) * counts[k], default=None)
    if kept is None or counts[kept] == 0:
        return None
    length = counts[kept]
    chosen = [record for record in records if record.drawn >= length]
    values = np.stack([record.values[:length] for record in chosen])
    counts_by_kernel = np.sum([record.state["counts"] for record in chosen], axis=0)
    acceptance = {
        part.name: float(accepted / steps) if steps else math.nan
        for part, (steps, accepted) in zip(mixed, counts_by_kernel, strict=True)
    }
    densities = np.stack([record.densities[:length] for record in chosen])
    told = {name: rate for name, rate in acceptance.items() if not math.isnan(rate)}
    return part_at(target, values, densities, 1.0, {"acceptance": told})


def run_until_agreed(
    plan: Plan, target: SceneTarget, most: int, jobs: int, report: Progress = silent, until: float | None = None,
    closely: bool = True,
) -> Outcome:  # fmt: skip
    """Return the Outcome of chains that go on, twice as long each time, while they disagree and it is worth it.

    most : draws of each chain beyond which they are not gone on with; as many as the plan has: they are not at all.
    jobs : how many run at a time. report : told of progress, as `run_chains` does. until : of the monotonic clock.
    closely : whether they are to agree as is asked of many draws, and are given up where that takes more than `most`;
        else as is enough to be trusted, and all the way, as what few draws say that it takes may be several times off.
    """
    while True:
        outcome = run_chains(plan, jobs, report)
        if plan.draws >= most or outcome.interrupted or outcome.lost or (until and time.monotonic() > until):
            return outcome
        wanted = _enough(target, outcome, plan.draws, closely)
        if wanted <= plan.draws or (closely and wanted > most):
            return outcome
        plan = plan._replace(draws=2 * plan.draws, records=outcome.records)


def _enough(target: SceneTarget, outcome: Outcome, draws: int, closely: bool) -> int:
    """Return how many draws of each chain are enough to be trusted, going by the first so many: 0 where these are."""
    columns = np.stack([record.values[:draws] for record in outcome.records.values()], axis=1).T  # (P, chains, draws)
    rows = [{**diagnostics.summary(column, period), "draws": column}
            for column, period in zip(columns, target.space.periods, strict=True)]  # fmt: skip
    far, largest = (doubtful, LIMITS[0]) if closely else (misleads, QUICK_LIMITS[0])
    return enough_draws(rows, largest) if any(map(far, rows)) else 0


def part_at(
    target: SceneTarget, values: np.ndarray, densities: np.ndarray, weight: float, extras: Any
) -> StructurePosterior:
    """Return a structure's draws, (chains, draws, P), with their densities, (chains, draws, 2), as a posterior part."""
    poses = None
    if any(address.startswith("root.") for address in target.space.addresses):
        poses = np.array([[target.root_pose(draw) for draw in chain] for chain in values])
    return StructurePosterior(target.template, target.space.addresses, values, densities[..., 0], densities[..., 1],
                              weight, target.space.periods, poses, extras)  # fmt: skip


def part_of_one(target: SceneTarget, values: np.ndarray, weight: float, extras: Any) -> StructurePosterior:
    """Return values (P,) as a posterior's part of one draw."""
    densities = np.array([[[target.log_prior(values), target.log_likelihood(values)]]])
    return part_at(target, values[None, None], densities, weight, extras)


def likeliest(shares: list[np.ndarray]) -> list[tuple[tuple[int, ...], float]]:
    """Return (what each object is, how probable that is against the likeliest), the likeliest first.

    shares : for each object, the probabilities (n,) of what it may be, whatever the others are. Of MOST_STRUCTURES,
        none below LEAST_LIKELY.
    """
    found: list[tuple[tuple[int, ...], float]] = [((), 1.0)]
    for share in shares:
        further = [((*chosen, number), weight * float(p)) for chosen, weight in found
                   for number, p in enumerate(share / share.max()) if weight * p >= LEAST_LIKELY]  # fmt: skip
        found = sorted(further, key=lambda each: -each[1])[:MOST_STRUCTURES]
    return found
