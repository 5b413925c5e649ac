"""Measure what an image tells of standing, and standing of an image, for `python scripts/evaluate.py verdicts` or
`stands`.

`verdicts`: images of flush towers of three to five boxes, every second of which falls (statics and simulation agree on
the truth); P(stable) is `posterior.probability` by statics.

`stands`: images of towers that stand; where their posterior leaves the verdict open, how much nearer to the truth their
centres come once `--assume-stable` has ruled out the draws that fall; and how much they would by the draws themselves,
each one that stands taken for the truth. Which towers count is decided by the image alone: had the truth been chosen
for being nearly unstable, it would lie at the border of what stands, where no honest interval that ends at that border
holds it. From low down much is hidden, so that many images leave the verdict open.
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

LOW = 5.0, 20.0  # degrees that a camera is up from which much is hidden
OPEN = 0.05, 0.95  # P(stable) of a verdict that an image leaves open
DRAWS = 400
FLOOR = Body("floor", "plane", np.zeros(3), np.eye(4))


def made_tower(rng, stands, **seen):
    """Return the scene dict of an image of a tower that stands, or falls. seen : of `photograph`."""
    while True:
        tower = stack(rng, int(rng.integers(3, 6)))
        blocks = enumerate(zip(tower[1], tower[2], strict=True))
        bodies = [Body(f"block_{k}", "box", size, pose) for k, (size, pose) in blocks]
        matter = Matter((FLOOR, *bodies), np.array([0.0, 0.0, -9.81]), ())
        verdict = Equilibrium(matter)
        if verdict.stands != stands or judge(simulate(matter, early=True)).stable != stands:
            continue
        scene = photograph(rng, *tower, **seen)
        if all(item["pixels"] >= 1 for item in scene["objects"]):
            return scene


def inferred(scene, k, options):
    return infer_structure(scene["depth"], scene["camera"], options, np.random.default_rng(k))


def image_verdict(k, options):
    """Return whether the k-th tower stands, and how probable that is given its image."""
    falls = bool(k % 2)
    scene = made_tower(np.random.default_rng([141, k]), not falls)
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
    """Return P(stable) of the k-th tower, and errors (2, N), expected ones (2, N) and hits (2, N, 3) of its centres.

    The first row is without the assumption that it stands, the second with it. Expected is an error where the truth is
    a draw that stands; a hit is a true coordinate inside the 90 % interval.
    """
    scene = made_tower(np.random.default_rng([142, k]), True, elevation=LOW)
    posterior = inferred(scene, k, options)
    truth = np.array([item["pose"][:3, 3] for item in scene["objects"]])
    graphs = posterior.graphs(np.random.default_rng(k), DRAWS)
    chance = probability(graphs, "stands", engine="statics").probability
    given = assume_stable(posterior)[0] if chance > 1 / DRAWS else posterior
    centres = [centres_of(each, truth, np.random.default_rng(k)) for each in (posterior, given)]
    means = np.array([each.mean(axis=0) for each in centres])
    expected = np.linalg.norm(means[:, None] - centres[1], axis=-1).mean(axis=1)
    low, high = np.quantile(centres, (0.05, 0.95), axis=1)
    return chance, np.linalg.norm(means - truth, axis=-1), expected, (low <= truth) & (truth <= high)


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
    """Print what --assume-stable does to the centres of towers seen from low down."""
    print_stands([open_tower(k, options) for k in range(first, first + count)])


def print_stands(told):
    ambiguous = [each for each in told if OPEN[0] < each[0] < OPEN[1]]
    print("| what | figure |\n|---|---|")
    print(f"| towers whose image leaves the verdict open | {len(ambiguous)} of {len(told)} |")
    for name, part in (("verdict open", ambiguous), ("all", told)):
        if not part:
            continue
        for what, row in (("error", 1), ("expected error", 2)):
            before, after = 1e3 * np.array([each[row].mean(axis=1) for each in part]).T
            print(f"| {what} of centres, {name}: before, after, mm | {before.mean():.2f}, {after.mean():.2f} |")
            print(f"| it falls by, {name} | {100 * (1 - after.mean() / before.mean()):.0f} % |")
        hits = np.concatenate([each[3].reshape(2, -1) for each in part], axis=1).mean(axis=1)
        print(f"| 90 % intervals hold the truth, {name}: before, after | {hits[0]:.2f}, {hits[1]:.2f} |", flush=True)
