"""Whether a predicted scene could be: does it float, overlap, stand?"""

from collections.abc import Mapping
from typing import Any

import numpy as np


def condition_of(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return what physics says of a scene as `derender show --json` prints it.

    Returns
    -------
    dict: `floating` (names of what no chain of touches, within 5 mm, joins to a plane), `intersecting` ([name, name,
    metres] of what overlaps by more than 5 mm), `stable` (whether all stays where it is for two seconds; None where the
    scene has no gravity), `fallen`.
    """
    from derender.physics.bodies import matter_of_scene
    from derender.physics.simulate import judge, simulate
    from derender.physics.stability import floating, intersecting

    known = bool(np.any(np.asarray(scene["gravity"], float)))
    matter = matter_of_scene(scene if known else {**scene, "gravity": [0.0, 0.0, -1.0]})
    found: dict[str, Any] = {
        "floating": floating(matter),
        "intersecting": [list(pair) for pair in intersecting(matter)],
        "stable": None,
        "fallen": [],
    }
    if known:
        verdict = judge(simulate(matter, early=True))
        found.update(stable=verdict.stable, fallen=list(verdict.fallen))
    return found
