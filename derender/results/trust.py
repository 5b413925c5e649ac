"""Whether a posterior is to be trusted: what its chains say of each other, and what its image says of it."""

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from derender.results.fit import Fit
    from derender.results.posterior import Posterior
    from derender.scene.graph import SceneGraph

LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"


class Region(NamedTuple):
    """A coherent set of pixels."""

    name: str  # a letter; on pictures it stands at the region
    mask: np.ndarray  # (H, W) bool
    share: float  # of the image's pixels with a depth

    @property
    def where(self) -> str:
        """Where its middle lies, such as "left of the middle"."""
        rows, columns = np.nonzero(self.mask)
        down, across = rows.mean() / self.mask.shape[0], columns.mean() / self.mask.shape[1]
        vertical = "" if 0.4 <= down <= 0.6 else "above" if down < 0.4 else "below"
        sideways = "" if 0.4 <= across <= 0.6 else "left of" if across < 0.4 else "right of"
        words = " and ".join(word for word in (vertical, sideways) if word)
        return f"{words or 'in'} the middle"


# Rank-normalised R-hat above the first, or fewer effective draws than the second, is not to be trusted (Vehtari et al.
# 2021).  So few draws as a quick look has cannot show that: there the older limits are kept (Gelman and Rubin 1992).
LIMITS, QUICK_LIMITS = (1.01, 100.0), (1.1, 25.0)
QUICK = 1000  # draws of all chains together, below which it was a quick look
SHARES_APART = 0.5  # between chains' shares of the likeliest structure, where too few change it to tell R-hat
MARGIN = 2.5  # times the draws that seem enough
LEAST_OF_VIEW = 0.95  # share of each of several views' depths that the scene explains
LIKELY_FLOOR = 0.05  # probability of another plane to be the floor from which on that is told
APART = 5.0  # nats between the evidences of populations that a few lucky particles may explain
SURE_EXISTENCE = 0.75  # probability that a trusted free-form thing is an object
MAY_EXIST = 0.45  # the same of what is not told, from which on it is as likely as not, within the probability's error
# Objects, and share of those told, that may be expected to be wrong: clutter that is told, objects that are not, and
# all, or that there is nothing, if another plane is the floor.
# One thing at less than three to two is too much. (Of 57 answers to variants of labelled real frames with nothing else
# to doubt, and with up to .6 expected, 7 of 51 were not right with less, and 3 of 6 with more.)
MOST_WRONG, FEW = 0.4, 0.05
# Probability that the search has missed what is there, from which on no structure found is likelier. ("Nothing"
# was told with .07, and trusted, of cartons from whose pixels 15 % returned. Of 163 answers to variants of labelled
# real frames two were trusted so: one was wrong, the other "nothing" of an empty tote.)
MOST_MISSED = 0.5
TOLD_COUNT = 0.05  # of objects; fewer are 0.0 in one digit, and not worth a word
FITS = 4.0  # standard deviations by which noise alone hardly ever leaves an image less likely than others of its scene
EXACT = 1e-3  # of an object's extent, to which no box is one, and up to which what chains leave open is said alone
OFF = 0.1  # of an object's extent: by less a real sensor tells its place, and what there is (an IoU of .8)


class Doubt(NamedTuple):
    """A reason to doubt a result."""

    words: str  # which and where, a plain sentence without a full stop
    serious: bool = True  # whether the result is not to be trusted for it; else it is worth knowing
    regions: tuple[Region, ...] = ()  # of the image that it is about, to be marked
    about: Collection[str] | None = None  # names of the objects that are in doubt for it; None: all if it is serious


def trusted(doubts: Sequence[Doubt]) -> bool:
    """Return whether none of the doubts is serious."""
    return not any(doubt.serious for doubt in doubts)


def in_doubt(doubts: Sequence[Doubt], graph: "SceneGraph") -> list[str]:
    """Return the names of the objects of a scene that are in doubt for any, and of what stands on them."""
    found: list[str] = []
    for vertex in graph.vertices:  # parents come first
        own = any(doubt.serious if doubt.about is None else vertex.name in doubt.about for doubt in doubts)
        if own or {vertex.parent, *vertex.supports} & set(found):
            found.append(vertex.name)
    return found


def with_all_in_doubt(doubts: tuple[Doubt, ...], graph: "SceneGraph") -> tuple[Doubt, ...]:
    """Return the doubts, and where they leave none of a scene's solids one that says so: of that nothing is trusted."""
    solids = {vertex.name for vertex in graph.vertices if vertex.body.size() is not None}
    if not solids or not trusted(doubts) or not solids <= set(in_doubt(doubts, graph)):
        return doubts
    words = "each of the objects is in doubt" if len(solids) > 1 else "the one object that was found is in doubt"
    return (*doubts, Doubt(words, about=()))


def judgement(doubts: Sequence[Doubt], graph: "SceneGraph", fit: "Fit | None" = None) -> dict[str, Any]:
    """Return what a posterior's `meta` holds of it, as JSON has it: `explained`, `trusted`, `doubts`, `in_doubt`."""
    told = {
        "trusted": trusted(doubts),
        "doubts": [doubt.words for doubt in doubts],
        "in_doubt": in_doubt(doubts, graph),
    }
    return told if fit is None else {"explained": round(fit.share, 4), **told}


def limits(draws: int) -> tuple[float, float]:
    """Return the largest R-hat and the smallest effective sample size to be trusted with so many draws in all."""
    return LIMITS if draws >= QUICK else QUICK_LIMITS


def doubtful(row: Mapping[str, Any]) -> bool:
    """Return whether the chains of a row of `tables.parameter_rows` disagree or hold too few effective draws."""
    r_hat, ess = row["r_hat"], row["ess_bulk"]
    largest, smallest = limits(row["draws"].size)
    return bool((np.isfinite(r_hat) and r_hat > largest) or (np.isfinite(ess) and ess < smallest))


def misleads(row: Mapping[str, Any]) -> bool:
    """Return whether the chains of a row say so different things that none of them is to be believed.

    Chains that differ by less than any quick look's may, and are worth enough draws together, ought to go on: what they
    tell is off by little of its own spread.
    """
    r_hat, ess, enough = row["r_hat"], row["ess_bulk"], limits(row["draws"].size)[1]
    return bool((np.isfinite(r_hat) and r_hat > QUICK_LIMITS[0]) or (np.isfinite(ess) and ess < enough))


def chain_doubts(posterior: "Posterior", rows: Sequence[Mapping[str, Any]]) -> tuple[Doubt, ...]:
    """Return the reasons not to trust a posterior that its chains give.

    rows : of `tables.parameter_rows`, about its most probable structure.
    """
    lost = len(posterior.meta.get("lost_chains", ()))
    doubts = [f"{lost} of the chains died"] if lost else []
    told = [
        Doubt(f"{name} is an object with a probability of {known:.2f} only: it may be clutter or a piece of one",
              False, about=(name,))
        for name, (known, _) in posterior.meta.get("existence", {}).items()
        if known < SURE_EXISTENCE and name in posterior.best_part.graph.names
    ]  # fmt: skip
    solids = [vertex.name for vertex in posterior.best_part.graph.vertices if vertex.body.size() is not None]
    none = sum(1.0 - posterior.object_probability(name) for name in solids)
    # What the image's border cuts is nowhere seen as it is: its like may be missed, and all the rest be right.
    more = sum(probability for probability, *_ in posterior.meta.get("clutter", ()))
    more += sum(posterior.object_probability(name) for name in posterior.best_part.extras.get("absent", ()))
    floors = [other for other in posterior.meta.get("other_floors", ()) if other["probability"] > LIKELY_FLOOR]
    all_wrong = max(len(solids), 1) * sum(other["probability"] for other in floors)
    serious = none + more + all_wrong > max(MOST_WRONG, FEW * len(solids))
    for other in floors:
        plane = ",".join(f"{number:.3g}" for number in other["plane"])
        words = f"another plane may be the floor, with a probability of {other['probability']:.2f}: --floor={plane}"
        told.append(Doubt(words, serious, about=None if serious else ()))
    if serious and max(none, more) >= TOLD_COUNT:
        parts = {f"of the {len(solids)} objects {none:.1f} are expected to be clutter, or pieces of others": none,
                 f"{more:.1f} objects are expected in what else is seen": more}  # fmt: skip
        doubts.append(", and ".join(words for words, count in parts.items() if count >= TOLD_COUNT))
    if (missed := posterior.meta.get("missed", 0.0)) >= MOST_MISSED:
        doubts.append(f"something was missed with a probability of {missed:.2f}: nothing that was found is likelier")
    told += [Doubt(f"{name} touches nothing: what bears it was not found", about=(name,))
             for name in posterior.meta.get("hanging", ())]  # fmt: skip
    if posterior.meta.get("no_floor"):  # what else is there is not known; what is told stands free, whatever bears it
        words = "no surface was found that things could stand on: only what stands free of all about it is told"
        told.append(Doubt(words, about=()))
    if posterior.meta.get("camera_guessed"):
        told.append(Doubt("no camera was given: with another field of view all sizes are others", False, about=()))
    if posterior.meta.get("interrupted"):
        doubts.append("it was interrupted: this is the best so far")
    for view in posterior.meta.get("views", ()):
        if view["explained"] < LEAST_OF_VIEW:
            doubts.append(f"{1.0 - view['explained']:.0%} of {view['image']} is not explained by what all images show")
    short = posterior.meta.get("short_of_noise", 0.0)
    if short > FITS:
        words = f"the image is {short:.0f} standard deviations less likely than images drawn of the best scene"
        why = "a better one was missed (see --seed), or the sensor is not as the likelihood says"
        doubts.append(f"{words}: {why}")
    evidence = posterior.best_part.extras.get("log_evidence", [0.0])
    if max(evidence) - min(evidence) > APART:
        doubts.append(f"the populations' log evidences are {max(evidence) - min(evidence):.1f} apart")
    chains, draws, _ = posterior.best_part.values.shape
    structures, rows = (posterior.meta.get("structure_chains", {}), rows) if draws >= 4 else ({}, ())
    faces = posterior.meta.get("faces", 0.0)
    over, shares = structures.get("r_hat"), structures.get("shares", [0.0])
    if over is not None and over > limits(chains * draws)[0]:
        doubts.append(f"the chains disagree about the structure: R-hat is {over:.3f}")
    elif max(shares) - min(shares) > SHARES_APART:
        spread = f"{min(shares):.2f} in one, {max(shares):.2f} in another"
        doubts.append(f"the chains disagree about the structure: the likeliest has {spread}")
    bad = sorted((row for row in rows if doubtful(row)), key=lambda row: -left_open(posterior, row))
    if bad:
        worst = [row for row in bad if misleads(row)]
        row = (worst or bad)[0]
        most = left_open(posterior, row)
        if worst:
            r_hat = f"R-hat {row['r_hat']:.3f}, " if np.isfinite(row["r_hat"]) else ""
            short = "the chain is too short for" if chains == 1 else "the chains are too short for"
            differ = "the chains disagree about" if row["r_hat"] > QUICK_LIMITS[0] else short
            words, needed = f"{differ} {row['address']}: {r_hat}", enough_draws(worst, QUICK_LIMITS[0])
        else:  # R-hat alone is above what many draws are asked for, by as little as a fourth digit
            r_hat = f"R-hat {row['r_hat']:.4f} (good up to {LIMITS[0]})"
            words, needed = f"the chains agree about {row['address']}, but not closely: {r_hat}, ", enough_draws(bad)
        count = f"{row['ess_bulk']:.0f}"
        words += f"{count} effective draw{'s' * (count != '1')}"
        words += "" if np.isinf(most) else f", which leave {float(f'{1000 * most:.1g}'):g} mm open"
        names = {row["address"].partition(".")[0] for row in worst if left_open(posterior, row) >= faces}
        own = names if np.isfinite(most) or not worst else None  # else of the root or the likelihood
        share = OFF if faces else EXACT
        far = any(left_open(posterior, row) > share * extent_of(posterior, row) for row in worst)
        told.append(Doubt(f"{words}; --draws {needed} would do", far, about=own))
    return (*map(Doubt, doubts), *told)


def left_open(posterior: "Posterior", row: Mapping[str, Any]) -> float:
    """Return by how many metres, one standard error, more draws would move an object in what is told of a number.

    A length by itself, an angle at half the object's diagonal, a number of a quaternion, which is half an angle, at all
    of it; inf for any other number. Real faces are off by the `faces` of a posterior's `meta`: chains that leave less
    open tell the same.
    """
    wide = float(np.linalg.norm(size_of(posterior, row)))
    moves = {"mm": 1.0, "°": 0.5 * wide, **dict.fromkeys(("qw", "qx", "qy", "qz"), wide)}
    factor = moves.get(row["unit"] or row["address"].rpartition(".")[2])
    independent = max(row["ess_bulk"], 1.0) if np.isfinite(row["ess_bulk"]) else 1.0
    return np.inf if not wide or factor is None else float(row["draws"].std() / np.sqrt(independent) * factor)


def extent_of(posterior: "Posterior", row: Mapping[str, Any]) -> float:
    """Return the metres that what is left open of a number is held against: a size itself, of which a box's width may
    be a third of its length; of where an object is, and how it is turned, its longest side."""
    size = row["unit"] == "mm" and ".contact." not in row["address"]
    return float(np.median(row["draws"]) if size else size_of(posterior, row).max())


def size_of(posterior: "Posterior", row: Mapping[str, Any]) -> np.ndarray:
    """Return the size (3,) of the object that a row is about, metres; zeros: of none, or of a plane."""
    name, graph = row["address"].partition(".")[0], posterior.best_part.graph
    size = graph.body(name).size() if name in graph.names else None
    return np.zeros(3) if size is None else np.asarray(size)


def enough_draws(rows: Sequence[Mapping[str, Any]], largest: float = LIMITS[0]) -> int:
    """Return how many draws of each chain the limits ask for, going by how fast these chains learn.

    largest : R-hat that is good of many draws; where less than the best will do, as much as `misleads` bears.

    Effective draws grow with the draws, and R-hat - 1 falls with them; MARGIN is for what short chains do not know of
    themselves.
    """
    chains, draws = rows[0]["draws"].shape

    def asked(total: int) -> int:
        least, smallest = limits(total)
        times = [smallest / row["ess_bulk"] for row in rows if np.isfinite(row["ess_bulk"]) and row["ess_bulk"] > 0]
        times += [(row["r_hat"] - 1.0) / (max(least, largest) - 1.0) for row in rows if np.isfinite(row["r_hat"])]
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
    r_hats, counts = ([row[key] for row in rows if np.isfinite(row[key])] for key in ("r_hat", "ess_bulk"))
    if told:
        return told + notes
    if not rows or any(map(doubtful, rows)):
        return [*notes, f"nothing {'serious ' if notes else ''}speaks against this scene"]
    if not counts:
        return ["nothing speaks against this scene; without draws nothing tells how sure its numbers are", *notes]
    largest, smallest = limits(rows[0]["draws"].size)
    agreement = "nothing speaks against this scene; one chain has none to agree with (--chains 2 would)"
    if r_hats:
        agreement = f"the chains agree: R-hat is at most {max(r_hats):.3f} (good up to {largest})"
    return [f"{agreement}, effective draws are at least {min(counts):.0f} (good from {smallest:.0f})", *notes]
