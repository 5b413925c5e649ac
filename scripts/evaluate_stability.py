"""Measure what an image tells of standing, and standing of an image, for `python scripts/evaluate.py verdicts` or
`stands`.

`verdicts`: images of flush towers of three to five boxes, every second of which falls (statics and simulation agree on
the truth); P(stable) is `posterior.probability` by statics.

`stands`: images of towers that stand; where their posterior leaves the verdict open, how much nearer to the truth their
centres come once `--assume-stable` has ruled out the draws that fall. Which towers count is decided by the image alone:
had the truth been chosen for being nearly unstable, it would lie at the border of what stands, where no honest interval
that ends at that border holds it. A margin below .15 g only spares the towers that no image leaves open.
"""

import numpy as np

from derender.physics.bodies import Body, Matter
from derender.physics.constraint import assume_stable
from derender.physics.outcome import probability
from derender.physics.simulate import judge, simulate
from derender.physics.statics import Equilibrium
from derender.scene.solids import PLANE
from derender.structures.infer import infer_structure
from worlds.made_scenes import photograph, stack

NEAR_EDGE = 0.15  # g; 80 % of an open posterior's margins spread over .02 to .09 g
OPEN = 0.05, 0.95  # P(stable) of a verdict that an image leaves open
DRAWS = 400
FLOOR = Body("floor", "plane", np.zeros(3), np.eye(4))


def made_tower(rng, wanted):
    """Return the scene dict of an image of a tower for which wanted(statics verdict, whether simulation agrees)."""
    while True:
        tower = stack(rng, int(rng.integers(3, 6)))
        blocks = enumerate(zip(tower[1], tower[2], strict=True))
        bodies = [Body(f"block_{k}", "box", size, pose) for k, (size, pose) in blocks]
        matter = Matter((FLOOR, *bodies), np.array([0.0, 0.0, -9.81]), ())
        verdict = Equilibrium(matter)
        if not wanted(verdict) or judge(simulate(matter, early=True)).stable != verdict.stands:
            continue
        scene = photograph(rng, *tower)
        if all(item["pixels"] >= 1 for item in scene["objects"]):
            return scene


def inferred(scene, k, options):
    return infer_structure(scene["depth"], scene["camera"], options, np.random.default_rng(k))


def image_verdict(k, options):
    """Return whether the k-th tower stands, and how probable that is given its image."""
    falls = bool(k % 2)
    scene = made_tower(np.random.default_rng([141, k]), lambda verdict: verdict.stands != falls)
    posterior = inferred(scene, k, options)
    graphs = posterior.graphs(np.random.default_rng(k), DRAWS)
    return not falls, probability(graphs, "stands", engine="statics", missed=posterior.missed).probability


def centres_of(posterior, truth, rng):
    """Return (DRAWS, N, 3): the centres of the solids that are nearest to the true ones (N, 3), in each draw."""
    found = []
    for graph in posterior.graphs(rng, DRAWS):
        solids = graph.solids()
        places = solids.pose[solids.kind != PLANE, :3, 3]
        if not len(places):
            places = np.zeros((1, 3))
        apart = np.linalg.norm(places[None] - truth[:, None], axis=2)
        found.append(places[apart.argmin(axis=1)])
    return np.array(found)


def open_tower(k, options):
    """Return P(stable) of the k-th tower near the edge, and errors (2, N) and hits (2, N, 3) of its centres.

    The first row is without the assumption that it stands, the second with it; a hit is a true coordinate inside the
    90 % interval.
    """
    scene = made_tower(np.random.default_rng([142, k]), lambda verdict: 0 < verdict.margin()[0] < NEAR_EDGE)
    posterior = inferred(scene, k, options)
    truth = np.array([item["pose"][:3, 3] for item in scene["objects"]])
    graphs = posterior.graphs(np.random.default_rng(k), DRAWS)
    chance = probability(graphs, "stands", engine="statics").probability
    rows = []
    for each in (posterior, assume_stable(posterior)[0] if chance > 1 / DRAWS else posterior):
        centres = centres_of(each, truth, np.random.default_rng(k))
        low, high = np.quantile(centres, (0.05, 0.95), axis=0)
        rows.append((np.linalg.norm(centres.mean(axis=0) - truth, axis=1), (low <= truth) & (truth <= high)))
    return chance, np.array([row[0] for row in rows]), np.array([row[1] for row in rows])


def evaluate_verdicts(count, first, options):
    """Print how right P(stable) is on images of towers."""
    told = [image_verdict(k, options) for k in range(first, first + count)]
    print_verdicts(np.array([each[0] for each in told]), np.array([each[1] for each in told]))


def print_verdicts(stands, chance):
    right = (chance > 0.5) == stands
    print("| what | figure |\n|---|---|")
    print(f"| towers from images right at P > .5 | {right.sum()} of {len(right)} |")
    print(f"| Brier score | {np.mean((chance - stands) ** 2):.3f} |")
    print(f"| log loss | {-np.mean(np.log(np.where(stands, chance, 1 - chance))):.3f} |")
    wrong = ", ".join(f"{p:.3f}" for p in chance[~right])
    print(f"| P(stable) of the wrong ones | {wrong or 'none'} |", flush=True)


def evaluate_stands(count, first, options):
    """Print what --assume-stable does to the centres of towers near the edge."""
    print_stands([open_tower(k, options) for k in range(first, first + count)])


def print_stands(told):
    ambiguous = [each for each in told if OPEN[0] < each[0] < OPEN[1]]
    print("| what | figure |\n|---|---|")
    print(f"| towers near the edge whose image leaves the verdict open | {len(ambiguous)} of {len(told)} |")
    for name, part in (("verdict open", ambiguous), ("all", told)):
        if not part:
            continue
        before, after = (np.array([each[1][row].mean() for each in part]) for row in (0, 1))
        print(f"| error of centres, {name}: before, after, mm | {1e3 * before.mean():.2f}, {1e3 * after.mean():.2f} |")
        print(f"| it falls by, {name} | {100 * (1 - after.mean() / before.mean()):.0f} % |")
        print(f"| worst rise of a tower's error, {name}, mm | {1e3 * max((after - before).max(), 0):.2f} |")
        hits = [np.concatenate([each[2][row].ravel() for each in part]).mean() for row in (0, 1)]
        print(f"| 90 % intervals hold the truth, {name}: before, after | {hits[0]:.2f}, {hits[1]:.2f} |", flush=True)
