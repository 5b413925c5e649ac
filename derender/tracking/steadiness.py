"""Whether a camera that is taken to stand moves: then the floor leaves where it was, or all that rests moves alike.

Beside one thing that moves along a floor a camera that does so instead looks the same, and so it does where things that
touch each other are all there is: of these nothing is said.
"""

from itertools import permutations
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse.csgraph import connected_components

from derender.physics.bodies import KIND_NAMES, Body
from derender.render.raycast.normal_equations import cost
from derender.scene.pose import inverse, rotation_vector
from derender.scene.solids import BOX
from derender.tracking import fit as fitting
from derender.tracking.drawing import OFF

if TYPE_CHECKING:
    from derender.tracking.track import Track
    from derender.tracking.tracker import Tracker

FLOOR_MOVES = "the floor moves"
MOVE_ALIKE = "{0} and {1} move alike and nothing rests, frames {2} to {3}"
GIVE = "{0}, as if the camera did: if it moves, give --moving-camera"

# Share of the floor's pixels that is off beside the usual one, from which on the floor is sought elsewhere: a hundredth
# is off while a hand is in the image, and a twentieth where a camera has turned by a fifth of a degree. It has moved
# where half of these pixels are explained so, from as far as a held camera comes in a second.
FLOOR_OFF, CURED, FAR = 0.03, 0.5, (0.05, 0.1)  # the last: metres and radians, standard deviations
LOOKS = 12  # frames at most, evenly spaced, between any two of which things may move alike
# A way is the metres that a thing's centre goes and those that its turn moves what is ARM from it. Ways are alike that
# agree to within a share, beside the metres by which two tracked poses may be off; what goes less rests.
ARM, ALIKE, ERROR, RESTS = 0.05, 1 / 3, 0.002, 0.003
APART = 0.005  # metres: things that are nearer push or bear each other, and move alike by that


def floor_moves(tracker: "Tracker") -> bool:
    """Whether the present frame shows the floor elsewhere than in the first one; all stays drawn as it is."""
    if not tracker.planes:
        return False
    members = np.arange(len(tracker.kinds)) < tracker.planes

    def off() -> float:
        fitting.pixels_of(tracker.misfit, tracker.counts, OFF)
        return float(tracker.counts[members, 2:].sum() / max(tracker.counts[members, 1].sum(), 1.0))

    before, view = off(), tracker.view.copy()
    if before < tracker.usually_off + FLOOR_OFF:
        return False
    drawn = tracker.poses.copy()
    tracker.fit_view([], np.diag(np.repeat(FAR, 3) ** -2.0))
    after = off()
    tracker.view, tracker.poses[:] = view, drawn
    cost(tracker.misfit, tracker.poses, tracker.sizes)
    return after - tracker.usually_off < CURED * (before - tracker.usually_off)


def doubts_of_camera(track: "Track", floor_moved: bool) -> list[str]:
    """Return what speaks against a camera that stands, in at most one sentence; floor_moved : see `floor_moves`."""
    if floor_moved:
        return [GIVE.format(FLOOR_MOVES)]
    shown = np.unique(np.linspace(0, len(track.times) - 1, LOOKS).round().astype(int))
    for end in shown:
        for begin in shown[shown < end]:
            if pair := _alike(track, begin, end):
                return [GIVE.format(MOVE_ALIKE.format(*pair, begin, end))]
    return []


def _alike(track: "Track", begin: int, end: int) -> list[str]:
    """Return the names of two things that moved alike from one frame to another and are of different piles, if no third
    thing rested that a camera of this motion would show to move; else []."""
    poses = track.poses[[begin, end]]
    here = np.flatnonzero(np.isfinite(poses[:, :, 0, 0]).all(axis=0)).tolist()

    def way(motion: np.ndarray, k: int) -> float:
        shift = motion[:3, :3] @ poses[0, k, :3, 3] + motion[:3, 3] - poses[0, k, :3, 3]
        turn = ARM * np.linalg.norm(rotation_vector(motion)) if track.kinds[k] == BOX else 0.0  # round things show none
        return float(np.linalg.norm(shift) + turn)

    motions = {k: poses[1, k] @ inverse(poses[0, k]) for k in here}
    ways = {k: way(motions[k], k) for k in here}
    for leader, other in permutations(here, 2):
        camera, least = motions[leader], min(ways[leader], ways[other])
        if track.kinds[leader] != BOX or way(inverse(motions[other]) @ camera, other) + ERROR > ALIKE * least:
            continue
        rests = any(ways[k] < RESTS < ALIKE * way(camera, k) for k in here)
        if not rests and not any(_of_one_pile(track, t, here, leader, other) for t in (begin, end)):
            return [track.names[k] for k in sorted((leader, other))]
    return []


def _of_one_pile(track: "Track", t: int, here: list[int], first: int, second: int) -> bool:
    """Whether two of the things that are here touch each other in a frame, or hang together by others that do."""
    bodies = [Body("", KIND_NAMES[int(track.kinds[k])], track.sizes[t, k], track.poses[t, k]) for k in here]
    _, piles = connected_components(np.array([[a.gap(b) < APART for b in bodies] for a in bodies]))
    return bool(piles[here.index(first)] == piles[here.index(second)])
