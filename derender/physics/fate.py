"""When the verdict on a running simulation is known: everything rests, or something has lost what bore it."""

import numpy as np

from derender.physics.bodies import Matter
from derender.physics.verdict import bearers
from derender.scene.graph import STANDARD_GRAVITY

# At rest: no corner has moved by more than this share of the smallest extent during the time below. Places and not
# speeds are compared, because contacts chatter, a ball on a slope that holds it creeps by an eighth of this, and blocks
# that have settled on uneven ones by up to a half.
DRIFT = 8e-3
# That time in units of sqrt(L / g), L the greatest extent: at a thousandth of g, the least that tips a scene over, a
# body moves by .008 L in it.
CALM_TIME = 4.0
# A body that has turned its upper side away by more than 60 degrees does not turn it back.
TURNED_AWAY = 0.5
# A body that has sunk by this share of its greatest extent more than all that bore it is borne by none of them: a plate
# that leans on one of two posts by 45 degrees has sunk by .35.
SUNK = 0.5
# After a body is lost the simulation goes on for so many times the time of a fall from the scene's height, so that what
# it held or hits falls too.
AFTERMATH = 2.0


class Fate:
    """What decides the verdict on a scene while it is simulated.

    Parameters
    ----------
    matter : the scene at the start. length : metres, its smallest extent.
    """

    def __init__(self, matter: Matter, length: float) -> None:
        moving = [body for body in matter.bodies if body.moves]
        strength = float(np.linalg.norm(matter.gravity))
        self._up = -matter.gravity / (strength or 1.0)
        self._sizes = np.array([body.size for body in moving], dtype=float).reshape(-1, 3)
        self._start = np.array([body.pose for body in moving], dtype=float).reshape(-1, 4, 4)
        self._drift = DRIFT * length
        longest = self._sizes.max(initial=length)
        self._calm = CALM_TIME * np.sqrt(longest / (strength or STANDARD_GRAVITY))
        heights = self._start[:, :3, 3] @ self._up
        tall = np.ptp(heights) + longest if moving else longest
        self._aftermath = AFTERMATH * np.sqrt(2 * tall / (strength or STANDARD_GRAVITY))
        place = {body.name: k for k, body in enumerate(moving)}
        borne = bearers(matter)
        self._bearers = [[place.get(name, -1) for name in borne[body.name]] for body in moving]
        self._rolls = np.array([body.kind == "sphere" for body in moving], dtype=bool)
        self._lost_at = np.inf

    def at_rest(self, times: np.ndarray, poses: np.ndarray) -> bool:
        """Return whether nothing has moved lately. times : (T,) seconds; poses : (T, M, 4, 4) of what moves."""
        before = poses[max(int(np.searchsorted(times, times[-1] - self._calm, side="right")) - 1, 0)]
        moved = np.linalg.norm(poses[-1, :, :3, 3] - before[:, :3, 3], axis=1)
        turned = np.linalg.norm(poses[-1, :, :3, :3] - before[:, :3, :3], axis=(1, 2)) / np.sqrt(2)
        calm = np.all(moved + 0.5 * np.linalg.norm(self._sizes, axis=1) * turned < self._drift)
        return bool(calm and times[-1] >= self._calm)

    def sealed(self, time: float, poses: np.ndarray) -> bool:
        """Return whether a body has lost what bore it, some time ago. poses : (M, 4, 4) of what moves."""
        if self._lost_at == np.inf and self._loses(poses):
            self._lost_at = time
        return time >= self._lost_at + self._aftermath

    def _loses(self, poses: np.ndarray) -> bool:
        if not np.any(self._up):
            return False
        upright = np.einsum("i,kij,klj,l->k", self._up, self._start[:, :3, :3], poses[:, :3, :3], self._up)
        if np.any(upright[~self._rolls] < TURNED_AWAY):
            return True
        # a plane or a fixed body, index -1, does not sink
        sunk = np.append((self._start[:, :3, 3] - poses[:, :3, 3]) @ self._up, 0.0)
        most = [max((sunk[k] for k in by), default=0.0) for by in self._bearers]
        return bool(np.any(sunk[:-1] - most > SUNK * self._sizes.max(axis=1)))
