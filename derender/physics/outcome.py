"""What will happen to a scene, and with which probability to an uncertain one: the functions for programs and planners.

    outcome = simulate_scene(graph, push=["red:+x:0.5N@0.1s"])
    chance = probability(posterior.graphs(rng, 200), lambda outcome: "red" in outcome.fallen, push=[...])

No files are touched; ten thousand calls cost ten thousand simulations. What is told of outcomes is plain data for JSON,
CSV and the terminal, with what physics had to assume of a scene that could not be.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from derender.errors import DerenderError
from derender.physics.bodies import LEAST_MASS, Matter, matter_of_graph
from derender.physics.intervention import Intervention, intervention
from derender.physics.statics import ContactForce, Equilibrium
from derender.physics.verdict import FALLS, SETTLES, STANDS, Trajectory, Verdict, judge
from derender.registry import suggest
from derender.scene.graph import SceneGraph
from derender.scene.pose import upright_frame

ENGINES = ("mujoco", "statics", "both")
LONGEST = 3600.0  # seconds simulated: a trajectory fits into memory
# A scene whose bodies still move after the time asked for is followed this many times longer before it is judged.
PATIENCE = 3.0
# What nobody has pushed, shaken or thrown and has gone further than this share of its mean extent is not waited for.
FAR = 0.4
# Draws before their spread is taken for what the next ones will do.
LEAST_DRAWS = 10


@dataclass(frozen=True)
class Outcome(Verdict):
    """What happens to a scene, by the simulation where there is one; statics know only what moves from the start.

    margin : the least horizontal acceleration that topples or slides something, g; None where it was not asked for.
    """

    by_engine: dict[str, str]  # the verdict of each engine asked
    margin: float | None
    forces: tuple[ContactForce, ...]  # contact forces that hold the scene, where asked for and where it can be held
    trajectory: Trajectory | None  # of the simulation, or None
    matter: Matter  # what was simulated


class Chance(NamedTuple):
    """A probability known from draws."""

    probability: float  # see `chance_of`
    error: float  # its Monte Carlo standard error
    draws: int  # how many


def simulate_scene(
    scene: "SceneGraph | Matter",
    *,
    engine: str = "mujoco",
    duration: float = 2.0,
    what: Intervention | None = None,
    margin: bool = False,
    forces: bool = False,
    early: bool = True,
    rng: np.random.Generator | None = None,
    **acts: Any,
) -> Outcome:
    """Return what happens to a scene.

    scene : a graph, its distributions drawn by `rng`, or bodies.
    engine : "mujoco", "statics" or "both"; statics judges the scene at rest, and says nothing of pushes and shaking.
    duration : seconds. early : stop as soon as the verdict is known; the trajectory is then short.
    acts : push, remove, add, tilt, shake, jitter, as of `derender simulate`; `what` says the same, read already.
    margin, forces : whether these are wanted.
    rng : of jitter and of what is a distribution; None: seed 0, and means.

    Raises DerenderError : an unknown object or engine, a push or shaking for statics alone, a text that cannot be read,
        a pose, size, mass or speed that is no finite number, numbers that diverge.
    """
    from derender.physics.simulate import simulate

    if engine not in ENGINES:
        raise DerenderError(f"no engine is called {engine!r}", None, "choose from " + " ".join(ENGINES))
    if not 0.0 < duration <= LONGEST:
        raise DerenderError(f"duration is {duration!r}", None, f"give seconds, at most {LONGEST:g}")
    if what is None:
        what = intervention(**acts)
    if isinstance(scene, Matter):
        matter, axes = scene, upright_axes(scene)
    else:
        matter, axes = matter_of_graph(scene, rng), np.asarray(scene.root_pose, dtype=float)[:3, :3]
    if engine == "statics" and (what.pushes or what.shake is not None):
        raise DerenderError("statics judges a scene at rest: it knows no pushes and no shaking", None, "ask mujoco")
    matter = what.apply(matter, axes, np.random.default_rng(0) if rng is None else rng)
    for body in matter.bodies:
        numbers = [*np.ravel(body.pose), *body.size, body.mass or 0.0, *body.velocity, *body.angular_velocity]
        if not np.isfinite(numbers).all() or (body.kind != "plane" and np.min(body.size) <= 0):
            raise DerenderError("a number of this object is not finite or a size not positive", body.name, "give it")
    found = Equilibrium(matter) if engine != "mujoco" or margin or forces else None
    by_engine: dict[str, str] = {}
    if engine != "mujoco":
        assert found is not None
        by_engine["statics"] = STANDS if found.stands else FALLS
    trajectory = None
    if engine == "statics" and found is not None:
        moved = dict.fromkeys(found.unbalanced(), 0.0)
        verdict = Verdict(by_engine["statics"], moved, {}, {}, tuple(found.entered))
    else:
        disturbance = what.in_scene(axes, duration)
        trajectory = simulate(matter, duration, early=early, disturbance=disturbance)
        verdict = judge(trajectory, matter)
        waits = disturbance is not None or matter.thrown or not _gone_far(trajectory)
        if verdict.verdict == FALLS and not trajectory.resting and waits:
            verdict = judge(simulate(matter, PATIENCE * duration, early=True, disturbance=disturbance), matter)
        by_engine["mujoco"] = verdict.verdict
    return Outcome(
        **vars(verdict), by_engine=by_engine, margin=found.margin()[0] if found is not None and margin else None,
        forces=tuple(found.forces()) if found is not None and forces else (), trajectory=trajectory, matter=matter,
    )  # fmt: skip


def outcomes(
    scenes: Iterable["SceneGraph | Matter"],
    what: Intervention,
    seed: int = 0,
    engine: str = "mujoco",
    duration: float = 2.0,
    jobs: int = 1,
    until: float | None = None,
    event: Callable[[Outcome], bool] = lambda outcome: outcome.stable,
    before: float = 0.5,
) -> Iterator[Outcome]:
    """Yield what happens to each of many draws of a scene; that of draw k depends on the seed and on k alone.

    What is done to a body is left out of the draws that do not have it.

    jobs : threads; the result does not depend on it.
    until : stop as soon as the standard error of the event's probability is no greater, after 10 scenes at least.
    before : the event's probability before any draw, see `chance_of`.
    """
    from concurrent.futures import ThreadPoolExecutor

    if jobs < 1:
        raise DerenderError(f"jobs is {jobs}", None, "give a whole number from 1")
    if until is not None and not until > 0.0:
        raise DerenderError(f"until is {until:g}", None, "give a standard error, more than none")

    known: set[str] = set()

    def run(item: "tuple[int, SceneGraph | Matter]") -> Outcome:
        scene, rng = item[1], np.random.default_rng([seed, item[0]])
        names = [body.name for body in scene.bodies] if isinstance(scene, Matter) else scene.solid_names
        known.update(names)
        return simulate_scene(scene, engine=engine, duration=duration, what=what.among(names), rng=rng)

    happened: list[bool] = []
    numbered = enumerate(scenes)
    with ThreadPoolExecutor(jobs) as pool:
        begun = deque(pool.submit(run, item) for item in islice(numbered, jobs))
        while begun:
            outcome = begun.popleft().result()
            begun.extend(pool.submit(run, item) for item in islice(numbered, 1))
            yield outcome
            if until is not None:
                happened.append(bool(event(outcome)))
                if len(happened) >= LEAST_DRAWS and chance_of(happened, before).error <= until:
                    break
    for name in sorted(what.names - known if known else ()):
        raise DerenderError(f"no object is called {name!r}", None, suggest(name, sorted(known)))


def chance_of(happened: Sequence[bool], before: float = 0.5, missed: float = 0.0) -> Chance:
    """Return how probable something is that happened in some of the draws, by Jeffreys' estimate, and its error.

    The estimate (k + 1/2) / (n + 1) is never surer than n draws can make it: a thousand that agree leave .0005.
    before : the probability before any draw, in place of that 1/2.
    missed : probability that what is there is none of the draws: of that no more is known than before them.
    """
    count = len(happened)
    if count == 0:
        return Chance(float("nan"), float("nan"), 0)
    centred = (sum(happened) + before) / (count + 1)
    error = float(np.sqrt(centred * (1 - centred) / (count + 2)))
    return Chance(centred + missed * (before - centred), (1 - missed) * error, count)


def chance_of_one(happens: bool, before: float = 0.5, missed: float = 0.0) -> Chance:
    """Return how probable something is that happens in the only scene there is, unless that was missed."""
    return Chance(happens + missed * (before - happens), 0.0, 1)


def probability(
    scenes: Iterable["SceneGraph | Matter"],
    event: Callable[[Outcome], bool] | str,
    *,
    until: float | None = None,
    seed: int = 0,
    engine: str = "mujoco",
    duration: float = 2.0,
    jobs: int = 1,
    missed: float = 0.0,
    alone: bool = False,
    **acts: Any,
) -> Chance:
    """Return how probable an event is over scenes, such as the draws of a posterior.

    event : what an `Outcome` must be like; or a verdict ("stands", "settles", "falls"), or the name of an object that
        moves.
    until : stop as soon as the standard error is no greater, after 10 draws at least.
    missed : see `chance_of`; of a posterior, `Posterior.missed`.
    alone : whether the scene, of which there is one, is the only one that there can be, so that it is no draw.
    acts : as of `simulate_scene`.
    """
    what = intervention(**acts)
    bodies: set[str] = set()
    verdicts, before = {STANDS, SETTLES, FALLS}, 0.5
    if isinstance(event, str):
        word, before = event, BEFORE.get(event, before)

        def event(outcome: Outcome) -> bool:
            bodies.update(body.name for body in outcome.matter.bodies)
            return outcome.verdict == word if word in verdicts else word in outcome.fallen

    runs = outcomes(scenes, what, seed, engine, duration, jobs, until, event, before)
    happened = [bool(event(run)) for run in runs]
    if not happened:
        raise DerenderError("there are no draws", None, "give draws from 1")
    chance = chance_of_one(happened[0], before, missed) if alone else chance_of(happened, before, missed)
    if bodies and word not in verdicts | bodies:
        raise DerenderError(f"{word!r} is no verdict and no object", None, suggest(word, verdicts | bodies))
    return chance


def upright_axes(matter: Matter) -> np.ndarray:
    """Return axes (3, 3), as columns, whose z points up: the floor's where there is one."""
    up = matter.up
    floor = next((body for body in matter.bodies if body.kind == "plane"), None)
    along = np.array([1.0, 0.0, 0.0]) if floor is None else floor.pose[:3, 0]
    if abs(along @ up) > 0.9:
        along = np.array([0.0, 1.0, 0.0])
    return upright_frame(up, along)[:3, :3]


def _gone_far(trajectory: Trajectory) -> bool:
    """Return whether a body has gone so far that, left alone, it cannot come to rest as the same structure."""
    moved = np.array(list(trajectory.greatest_displacement().values()))
    return bool(np.any(moved >= FAR * np.cbrt(np.prod(trajectory.sizes, axis=1))))


# Bodies that are so many times longer than wide are needles: their verdicts hang on the last tenth of a millimetre.
NEEDLE = 200.0
# What a smaller horizontal acceleration (g) tips over or sets sliding stands by calculation alone: a cube on its edge.
LEAST_MARGIN = 1e-3


def assumptions(outcome: Outcome) -> list[str]:
    """Return what is assumed beyond what a scene says, and of its trajectory after it ends; [] where nothing is."""
    matter, trajectory = outcome.matter, outcome.trajectory
    said = [
        f"{first} and {second} overlap by {1e3 * depth:.1f} mm: no rigid bodies can, so this does not stand"
        for first, second, depth in outcome.entered
    ]
    masses = {body.name: body.weight_in_kg() for body in matter.bodies if body.moves}
    heaviest = max(masses.values(), default=0.0)
    for name, mass in masses.items():
        if mass < LEAST_MASS * heaviest:
            said.append(f"{name} weighs {mass:.2g} kg: it is taken for {LEAST_MASS * heaviest:.2g} kg, beside the rest")
    for body in matter.bodies:
        if body.kind != "plane" and np.max(body.size) > NEEDLE * np.min(body.size):
            said.append(f"{body.name} is a needle or a leaf: what it does hangs on less than can be measured")
    if outcome.stable and masses and Equilibrium(matter).margin()[0] < LEAST_MARGIN:
        said.append(f"it is balanced so finely that less than {LEAST_MARGIN:g} g ends it: nothing real stands so")
    if masses and not any(not body.moves for body in matter.bodies):
        said.append("there is no floor and nothing is fixed: everything falls")
    if not np.any(matter.gravity):
        said.append("there is no gravity")
    if trajectory is not None and not trajectory.resting and not trajectory.first_moved():
        said.append(f"after {trajectory.times[-1]:.2g} s not all is known to rest: it is taken to stay; run it longer")
    return said


def assumed_of_draws(runs: Sequence[Outcome], what: Intervention) -> list[str]:
    """Return what is assumed of the draws of an uncertain scene beyond that of the most probable one."""
    deep = sum(bool(run.entered) for run in runs)
    said = [f"in {deep} of {len(runs)} draws solids enter each other deep: those do not stand"] if deep else []
    there = [{body.name for body in run.matter.bodies} for run in runs]
    for name in sorted(what.names.difference(what.remove)):
        if lacking := sum(name not in names for names in there):
            said.append(f"in {lacking} of {len(runs)} draws there is no {name}: nothing is done to it there")
    return said


# Draws that each verdict is worth beforehand, one in all, so that no verdict is surer than the draws can make it.
BEFORE = {STANDS: 0.5, SETTLES: 0.25, FALLS: 0.25}
LEAST_TOLD = 0.01  # of a probability that is said with two digits
# As `summary_of` names them: p_verdict_settles, p_verdict_falls are of the scene, p_falls of each of its objects.
COLUMNS = (
    "scene", "verdict", "stable", "p_stable", "p_stable_error", "p_verdict_settles", "p_verdict_settles_error",
    "p_verdict_falls", "p_verdict_falls_error", "draws", "missed", "margin", "fallen", "p_falls", "mujoco", "statics",
    "assumed", "fault",
)  # fmt: skip


def summary_of(best: Outcome, runs: Sequence[Outcome], assumed: Sequence[str], missed: float = 0.0) -> dict[str, Any]:
    """Return what `derender simulate --json` prints of a scene.

    best : of the most probable scene. runs : of the draws; `best` alone where there are none.
    assumed : sentences. missed : see `chance_of`.
    """

    def chance(alone: bool, drawn: Sequence[bool], word: str) -> Chance:
        if len(runs) == 1 and runs[0] is best:
            return chance_of_one(alone, BEFORE[word], missed)
        return chance_of(drawn, BEFORE[word], missed)

    stood = [run.stable for run in runs]
    stable = chance(best.stable, stood, STANDS)
    verdicts = {word: chance(best.verdict == word, [run.verdict == word for run in runs], word) for word in BEFORE}
    found: dict[str, Any] = {
        "verdict": best.verdict,
        "margin": best.margin,
        "stable": best.stable,
        "p_stable": stable.probability,
        "p_stable_error": stable.error,
        "p_verdict": {word: told.probability for word, told in verdicts.items()},
        "p_verdict_error": {word: told.error for word, told in verdicts.items()},
        "p_falls": {},
        "p_falls_error": {},
        "engines": best.by_engine,
        "displacement": best.displacement,
        "rotation": best.rotation,
        "fallen": list(best.fallen),
        "first_moved": best.first_moved,
        "assumed": list(assumed),
        "draws": len(runs),
        "draws_stable": sum(stood),
        "missed": missed,
    }
    for body in best.matter.bodies:
        if body.kind == "plane":
            continue
        there = [run for run in runs if any(other.name == body.name for other in run.matter.bodies)]
        fell = [run.verdict == FALLS and body.name in run.fallen for run in there]
        falls = chance(any(fell), fell, FALLS)
        found["p_falls"][body.name] = falls.probability if there else None
        found["p_falls_error"][body.name] = falls.error if there else None
    if all(len(run.by_engine) > 1 for run in runs):
        stand = [[word == STANDS for word in run.by_engine.values()] for run in runs]
        found["p_engines_agree"] = float(np.mean([first == second for first, second in stand]))
    if best.trajectory is not None:
        last = best.trajectory.poses[-1]
        found["resting"] = best.trajectory.resting
        found["final_pose"] = {name: last[k].tolist() for k, name in enumerate(best.trajectory.names)}
    if best.forces:
        found["forces"] = [force._asdict() for force in best.forces]
    return found


def told_of_missed(found: Mapping[str, Any]) -> str:
    """Return what to say beside P(stable) of what a summary counts for scenes that no draw is of, or ""."""
    share = found.get("missed")
    if not isinstance(share, int | float) or share < LEAST_TOLD:
        return ""
    return f"half of the {share:.2f} that it is none of the structures found counts as stable".replace("0.", ".")


def row_of(name: str, found: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row of a scene in a table of many; of one that could not be simulated, `found` has a `fault` alone."""
    row = dict.fromkeys(COLUMNS) | {"scene": name} | {key: found[key] for key in COLUMNS if key in found}
    if "fault" in found:
        return row
    words = {"fallen": " ".join(found["fallen"]), "assumed": "; ".join(found["assumed"])}
    for word in (SETTLES, FALLS):
        words |= {f"p_verdict_{word}{end}": found[f"p_verdict{end}"][word] for end in ("", "_error")}
    return row | words | dict(found["engines"])
