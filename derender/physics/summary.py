"""What is told of an outcome, and of many: plain data for JSON, CSV and the terminal.

Also what physics had to assume of a scene that could not be, said in sentences instead of being done in silence.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from derender.errors import DerenderError
from derender.physics.bodies import Matter
from derender.physics.materials import LEAST_MASS
from derender.physics.outcome import Chance, Outcome, chance_of
from derender.physics.statics import find_contacts, widest_gap
from derender.physics.verdict import FALLS, SETTLES, STANDS

# Bodies that are so many times longer than wide are needles: their verdicts hang on the last tenth of a millimetre.
NEEDLE = 200.0


def assumptions(matter: Matter) -> list[str]:
    """Return what is assumed of a scene beyond what it says; [] where nothing is.

    Raises
    ------
    DerenderError : a pose, size, mass or speed that is no finite number.
    """
    for body in matter.bodies:
        numbers = [*np.ravel(body.pose), *body.size, body.mass or 0.0, *body.velocity, *body.angular_velocity]
        if not np.isfinite(numbers).all() or (body.kind != "plane" and np.min(body.size) <= 0):
            raise DerenderError("a number of this object is not finite or a size not positive", body.name, "give it")
    said = []
    deepest = widest_gap(matter.unit)
    contacts = find_contacts(matter)
    seen = set()
    for first, second, gap in zip(contacts.first, contacts.second, contacts.gap, strict=True):
        pair = matter.bodies[first].name, matter.bodies[second].name
        if gap < -deepest and pair not in seen:
            seen.add(pair)
            said.append(
                f"{pair[0]} and {pair[1]} overlap by {-1e3 * gap:.1f} mm: they are taken to rest as they are, but such "
                "a scene cannot be"
            )
    masses = {body.name: body.weight_in_kg() for body in matter.bodies if body.moves}
    heaviest = max(masses.values(), default=0.0)
    for name, mass in masses.items():
        if mass < LEAST_MASS * heaviest:
            said.append(f"{name} weighs {mass:.2g} kg: it is taken for {LEAST_MASS * heaviest:.2g} kg, beside the rest")
    for body in matter.bodies:
        if body.kind != "plane" and np.max(body.size) > NEEDLE * np.min(body.size):
            said.append(f"{body.name} is a needle or a leaf: what it does hangs on less than can be measured")
    if masses and not any(not body.moves for body in matter.bodies):
        said.append("there is no floor and nothing is fixed: everything falls")
    if not np.any(matter.gravity):
        said.append("there is no gravity")
    return said


# Draws that each verdict is worth beforehand, one in all, so that no verdict is surer than the draws can make it.
BEFORE = {STANDS: 0.5, SETTLES: 0.25, FALLS: 0.25}
COLUMNS = (
    "scene", "verdict", "stable", "p_stable", "p_stable_error", "margin", "fallen", "mujoco", "statics", "fault",
)  # fmt: skip


def summary_of(best: Outcome, runs: Sequence[Outcome], assumed: Sequence[str], missed: float = 0.0) -> dict[str, Any]:
    """Return what `derender simulate --json` prints of a scene.

    Parameters
    ----------
    best : of the most probable scene. runs : of the draws; the scene's own alone where it is certain.
    assumed : sentences. missed : see `chance_of`.
    """
    drawn = len(runs) > 1
    stable = chance_of([run.stable for run in runs], missed=missed) if drawn else Chance(float(best.stable), 0.0, 1)
    found: dict[str, Any] = {
        "verdict": best.verdict,
        "margin": best.margin,
        "stable": best.stable,
        "p_stable": stable.probability,
        "p_stable_error": stable.error,
        "p_verdict": {
            word: chance_of([run.verdict == word for run in runs], share, missed).probability
            if drawn
            else float(best.verdict == word)
            for word, share in BEFORE.items()
        },
        "p_falls": {},
        "p_falls_error": {},
        "engines": best.by_engine,
        "displacement": best.displacement,
        "rotation": best.rotation,
        "fallen": list(best.fallen),
        "first_moved": best.first_moved,
        "assumed": list(assumed),
        "draws": len(runs),
    }
    for body in best.matter.bodies:
        if body.kind == "plane":
            continue
        there = [run for run in runs if any(other.name == body.name for other in run.matter.bodies)]
        falls = [run.verdict == FALLS and body.name in run.fallen for run in there]
        chance = chance_of(falls, BEFORE[FALLS], missed) if drawn else Chance(float(any(falls)), 0.0, 1)
        found["p_falls"][body.name] = chance.probability if there else None
        found["p_falls_error"][body.name] = chance.error if there else None
    if all(len(run.by_engine) > 1 for run in runs):
        found["p_engines_agree"] = float(np.mean([_agree(run) for run in runs]))
    if best.trajectory is not None:
        last = best.trajectory.poses[-1]
        found["resting"] = best.trajectory.resting
        found["final_pose"] = {name: last[k].tolist() for k, name in enumerate(best.trajectory.names)}
    if best.forces:
        found["forces"] = [force._asdict() for force in best.forces]
    return found


def row_of(name: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row of a scene in a table of many."""
    row = dict.fromkeys(COLUMNS) | {"scene": name}
    row |= {key: found[key] for key in ("verdict", "stable", "p_stable", "p_stable_error", "margin")}
    return row | {"fallen": " ".join(found["fallen"])} | dict(found["engines"])


def failed_row(name: str, fault: str) -> dict[str, Any]:
    """Return the row of a scene that could not be simulated."""
    return dict.fromkeys(COLUMNS) | {"scene": name, "fault": fault}


def _agree(run: Outcome) -> bool:
    """Return whether both engines say that it stands, or both that it does not."""
    return (run.by_engine["mujoco"] == STANDS) == (run.by_engine["statics"] == STANDS)
