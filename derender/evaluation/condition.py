"""Whether a scene could be: what floats, what overlaps, and whether it stands."""

from collections.abc import Mapping
from itertools import combinations
from typing import Any

import numpy as np

from derender.physics.bodies import Matter
from derender.physics.mujoco_model import World

TOLERANCE = 0.005  # metres by which contacts of real scenes are open or closed and still are contacts


def condition_of(scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return what physics says of a scene as `derender show --json` prints it.

    Returns
    -------
    dict: `floating` (names of what no chain of touches, within 5 mm, joins to a plane), `intersecting` ([name, name,
    metres] of what overlaps by more than 5 mm), `stable` (whether all stays where it is for two seconds; None where the
    scene has no gravity), `fallen`.
    """
    from derender.evaluation.condition import floating, intersecting
    from derender.physics.bodies import matter_of_scene
    from derender.physics.simulate import judge, simulate

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


def gaps(matter: Matter, limit: float = 1.0) -> dict[tuple[str, str], float]:
    """Return the signed distance of each pair of bodies in metres (negative: how deep they overlap).

    Pairs of planes are left out; distances beyond `limit` are `limit`.
    """
    world = World(matter, keep_contacts=False)
    kinds = {body.name: body.kind for body in matter.bodies}
    return {
        (a, b): world.gap(a, b, limit) for a, b in combinations(world.names, 2) if not (kinds[a] == kinds[b] == "plane")
    }


def floating(matter: Matter, tolerance: float = TOLERANCE) -> list[str]:
    """Return the bodies that nothing joins to a plane or a fixed body, through touches within `tolerance` metres."""
    near = [pair for pair, gap in gaps(matter).items() if gap <= tolerance]
    held = {body.name for body in matter.bodies if body.kind == "plane" or body.fixed}
    reached = held
    while reached:
        reached = {name for pair in near if held & set(pair) for name in pair} - held
        held |= reached
    return [body.name for body in matter.bodies if body.name not in held]


def intersecting(matter: Matter) -> list[tuple[str, str, float]]:
    """Return the pairs of bodies that overlap by more than TOLERANCE, and by how much, metres."""
    return [(*pair, -gap) for pair, gap in gaps(matter).items() if gap < -TOLERANCE]
