"""Whether a posterior is to be trusted: what its chains say of each other, and what its image says of it."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from derender.results.fit import Fit
    from derender.results.posterior import Posterior
    from derender.results.regions import Region

# Rank-normalised R-hat above the first, or fewer effective draws than the second, is not to be trusted (Vehtari et al.
# 2021).  So few draws as a quick look has cannot show that: there the older limits are kept (Gelman and Rubin 1992).
LIMITS, QUICK_LIMITS = (1.01, 100.0), (1.1, 25.0)
QUICK = 1000  # draws of all chains together, below which it was a quick look
SHARES_APART = 0.5  # between chains' shares of the likeliest structure, where too few change it to tell R-hat
MARGIN = 2.5  # times the draws that seem enough
LEAST_OF_VIEW = 0.95  # share of each of several views' depths that the scene explains
LEAST_EXISTENCE = 0.8  # probability that each free-form thing of a trusted answer is an object
APART = 5.0  # nats between the evidences of populations that a few lucky particles may explain


class Doubt(NamedTuple):
    """A reason to doubt a result.

    Attributes
    ----------
    words : which and where, a plain sentence without a full stop.
    serious : whether the result is not to be trusted for it; else it is worth knowing.
    regions : of the image that it is about, to be marked.
    """

    words: str
    serious: bool = True
    regions: "tuple[Region, ...]" = ()


def trusted(doubts: Sequence[Doubt]) -> bool:
    """Return whether none of the doubts is serious."""
    return not any(doubt.serious for doubt in doubts)


def judgement(doubts: Sequence[Doubt], fit: "Fit | None" = None) -> dict[str, Any]:
    """Return what a posterior's `meta` holds of it, as JSON has it: `explained`, `trusted` and `doubts`."""
    told = {"trusted": trusted(doubts), "doubts": [doubt.words for doubt in doubts]}
    return told if fit is None else {"explained": round(fit.share, 4), **told}


def limits(draws: int) -> tuple[float, float]:
    """Return the largest R-hat and the smallest effective sample size to be trusted with so many draws in all."""
    return LIMITS if draws >= QUICK else QUICK_LIMITS


def doubtful(row: Mapping[str, Any]) -> bool:
    """Return whether the chains of a row of `tables.parameter_rows` disagree or hold too few effective draws."""
    r_hat, ess = row["r_hat"], row["ess_bulk"]
    largest, smallest = limits(row["draws"].size)
    return bool((np.isfinite(r_hat) and r_hat > largest) or (np.isfinite(ess) and ess < smallest))


def worst_of(rows: Sequence[Mapping[str, Any]]) -> tuple[Mapping[str, Any] | None, Mapping[str, Any] | None]:
    """Return the row with the largest R-hat and that with the fewest effective draws; None where there is none."""
    split = [row for row in rows if np.isfinite(row["r_hat"])]
    short = [row for row in rows if np.isfinite(row["ess_bulk"])]
    return max(split, key=lambda row: row["r_hat"], default=None), min(
        short, key=lambda row: row["ess_bulk"], default=None
    )


def chain_doubts(posterior: "Posterior", rows: Sequence[Mapping[str, Any]], lost: int = 0) -> tuple[Doubt, ...]:
    """Return the reasons not to trust a posterior that its chains give.

    rows : of `tables.parameter_rows`, about its most probable structure. lost : how many chains died.
    """
    doubts = [f"{lost} of the chains died"] if lost else []
    if posterior.meta.get("no_floor"):
        doubts.append("no surface was found that things could stand on: only what stands free of all about it is told")
    doubts += [
        f"{name} is an object with a probability of {known:.2f} only: it may be clutter or a piece of one"
        for name, (known, _) in posterior.meta.get("existence", {}).items()
        if known < LEAST_EXISTENCE and name in posterior.best_part.graph.names
    ]
    if posterior.meta.get("interrupted"):
        doubts.append("it was interrupted: this is the best so far")
    for view in posterior.meta.get("views", ()):
        if view["explained"] < LEAST_OF_VIEW:
            doubts.append(f"{1.0 - view['explained']:.0%} of {view['image']} is not explained by what all images show")
    structures = posterior.meta.get("structure_chains", {})
    evidence = posterior.meta.get("log_evidence") or [0.0]
    if max(evidence) - min(evidence) > APART:
        doubts.append(f"the populations' log evidences are {max(evidence) - min(evidence):.1f} apart")
    chains, draws, _ = posterior.best_part.values.shape
    if draws < 4:
        return tuple(map(Doubt, doubts))
    largest, smallest = limits(chains * draws)
    over, shares = structures.get("r_hat"), structures.get("shares", [0.0])
    if over is not None and over > largest:
        doubts.append(f"the chains disagree about the structure: R-hat is {over:.3f}")
    elif max(shares) - min(shares) > SHARES_APART:
        spread = f"{min(shares):.2f} in one, {max(shares):.2f} in another"
        doubts.append(f"the chains disagree about the structure: the likeliest has {spread}")
    worst, least = worst_of(rows)
    if worst and worst["r_hat"] > largest:
        doubts.append(f"the chains disagree: R-hat of {worst['address']} is {worst['r_hat']:.3f}")
    if least and least["ess_bulk"] < smallest:
        doubts.append(f"{least['address']} has only {least['ess_bulk']:.0f} effective draws")
    if any(map(doubtful, rows)):
        doubts[-1] += f"; --draws {enough_draws(rows)} would do"
    return tuple(map(Doubt, doubts))


def enough_draws(rows: Sequence[Mapping[str, Any]]) -> int:
    """Return how many draws of each chain the limits ask for, going by how fast these chains learn.

    Effective draws grow with the draws, and R-hat - 1 falls with them; MARGIN is for what short chains do not know of
    themselves.
    """
    chains, draws = rows[0]["draws"].shape

    def asked(total: int) -> int:
        largest, smallest = limits(total)
        times = [smallest / row["ess_bulk"] for row in rows if np.isfinite(row["ess_bulk"]) and row["ess_bulk"] > 0]
        times += [(row["r_hat"] - 1.0) / (largest - 1.0) for row in rows if np.isfinite(row["r_hat"])]
        return int(np.ceil(MARGIN * draws * max([1.0, *times])))

    needed = asked(chains * draws)
    if chains * needed >= QUICK:
        needed = asked(chains * needed)  # no quick look any more
    digits = 10 ** max(len(str(needed)) - 2, 0)
    return -(-needed // digits) * digits


def verdict(doubts: Sequence[Doubt], rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return lines that say whether a result is to be trusted; what is worth knowing comes last."""
    told = [f"not to be trusted: {doubt.words}" for doubt in doubts if doubt.serious]
    notes = [f"worth knowing: {doubt.words}" for doubt in doubts if not doubt.serious]
    worst, least = worst_of(rows)
    if told or not rows:
        return told + notes
    if worst is None or least is None:  # no two chains to compare
        return ["nothing speaks against this scene; without draws nothing tells how sure it is", *notes]
    largest, smallest = limits(worst["draws"].size)
    agreement = (
        f"the chains agree: R-hat is at most {worst['r_hat']:.3f} (good up to {largest}), effective draws are at least "
        f"{least['ess_bulk']:.0f} (good from {smallest:.0f})"
    )
    return [agreement, *notes]
