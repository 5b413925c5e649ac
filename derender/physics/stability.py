"""Whether a scene hangs together: what floats, and what overlaps."""

from itertools import combinations

from derender.physics.bodies import Matter
from derender.physics.mujoco_model import World

TOLERANCE = 0.005
"""Metres by which contacts of real scenes are open or closed and still are contacts."""


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


def intersecting(matter: Matter, tolerance: float = TOLERANCE) -> list[tuple[str, str, float]]:
    """Return the pairs of bodies that overlap by more than `tolerance` metres, and by how much."""
    return [(*pair, -gap) for pair, gap in gaps(matter).items() if gap < -tolerance]
