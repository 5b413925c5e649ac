"""Whether what stands would fall off its supports, did no friction hold it: a term of every structure's density."""

import numpy as np

from derender.detection.solids.beliefs import bare_image
from derender.detection.solids.polish import UPRIGHT
from derender.detection.solids.state import FLOOR
from derender.detection.solids.statics import shares_of_load
from derender.detection.solids.support import TOUCHING
from derender.scene.solids import BOX


def log_standing(state, rules):
    """Return the log of what the prior gives a state less for what would tip; 0 where solids may float."""
    if rules.floating:
        return 0.0
    beliefs = bare_image() if rules.beliefs is None else rules.beliefs
    return float(np.log(beliefs.loose.tipping)) * unheld(state)


def unheld(state):
    """Return how many upright solids would tip off what is level with their bottoms, did no friction hold them."""
    upright = [k for k in range(len(state)) if state.forms[k] == UPRIGHT and not balanced(state, k)]
    return sum(not shares_of_load(state.rows, k, TOUCHING, friction=0.0) for k in upright)


def balanced(state, k):
    """Whether a solid is surely held: it stands on the floor, or its centre lies over the top of its parent."""
    parent = state.parents[k]
    if parent == FLOOR or np.isnan(state.bottoms[k]):
        return True
    on, apart = state.rows[parent], state.rows[k][10:12] - state.rows[parent][10:12]
    if int(on[0]) != BOX:
        return bool(np.hypot(*apart) < 0.5 * on[13])
    along = np.abs(on[1:10].reshape(3, 3)[:2, :2].T @ apart)
    return bool(state.forms[parent] == UPRIGHT and (along < 0.5 * on[13:15]).all())
