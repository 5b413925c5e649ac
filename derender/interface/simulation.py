"""What `derender.simulate`, `Scene.simulate` and `Posterior.probability` do: physics, without files."""

from collections.abc import Callable, Mapping, Sequence
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np

from derender.interface.functions import as_scene, load
from derender.interface.posterior import Posterior
from derender.interface.scene import Scene
from derender.physics.intervention import intervention
from derender.physics.outcome import Chance, Outcome, probability, simulate_scene
from derender.registry import only_its_keywords
from derender.scene.graph import SceneGraph

MOST_DRAWS = 100_000  # simulated where an error is asked for


class Acts(TypedDict, total=False):
    """Interventions, as texts that `derender simulate --help` explains, directions in the root's axes.

    push : such as "red:+x:0.5N@0.1s"; remove : names; add : such as "new:box:10x5x5cm@red"; one text or several each.
    tilt : of the floor, "10deg:+x". shake : of the floor, "2Hz:5mm:+x".
    jitter : "2mm,1deg", standard deviations by which each draw displaces and turns every object.
    """

    push: str | Sequence[str]
    remove: str | Sequence[str]
    add: str | Sequence[str]
    tilt: str | None
    shake: str | None
    jitter: str | None


class How(Acts, total=False):
    """Interventions, and how they are simulated; see `simulate`."""

    engine: str
    duration: float
    jobs: int


class Simulation(NamedTuple):
    """What physics says of a scene or a posterior.

    verdict : "stands", "settles" or "falls", of the (most probable) scene. stable : whether it stands.
    p_stable : how probable standing is, p_stable_error : its Monte Carlo error; of a scene alone 1 or 0, and 0.
    displacement : metres that each body moved, by name. rotation : radians that it turned.
    fallen : names of the bodies that did not stay, the first first.
    margin : the least horizontal acceleration that topples or slides something, g; None where it was not asked for.
    times : (T,) seconds. poses : (T, N, 4, 4), body to camera, of the bodies `names`; T is 0 with engine "statics".
    """

    verdict: str
    stable: bool
    p_stable: float
    p_stable_error: float
    displacement: dict[str, float]
    rotation: dict[str, float]
    fallen: tuple[str, ...]
    margin: float | None
    times: np.ndarray
    poses: np.ndarray
    names: tuple[str, ...]


@only_its_keywords
def simulate(
    scene: Scene | SceneGraph | Posterior | str | Path,
    *,
    duration: float = 2.0,
    draws: int = 50,
    until: float | None = None,
    engine: str = "mujoco",
    margin: bool = False,
    early: bool = False,
    push: str | Sequence[str] = (),
    remove: str | Sequence[str] = (),
    add: str | Sequence[str] = (),
    tilt: str | None = None,
    shake: str | None = None,
    jitter: str | None = None,
    jobs: int = 1,
    seed: int = 0,
) -> Simulation:
    """Let gravity act on a scene, or on the draws of a posterior, and say whether it stands.

    scene : a Scene, a scene graph, a Posterior, a scene file or a folder of results.
    duration : seconds. engine : "mujoco", "statics" or "both".
    draws : of a posterior or of the jitter, for p_stable. until : draw until its standard error is no greater.
    margin : whether that is worked out too. early : stop as soon as the verdict is known; the trajectory is then short.
    push, remove, add, tilt, shake, jitter : see `Acts`.
    jobs : threads. seed : of the draws and of the jitter.

    Raises DerenderError : an unknown object, a text that cannot be read, numbers that diverge.

    >>> import derender
    >>> scene = derender.sample("stack", seed=0)
    >>> derender.simulate(scene, duration=0.2).names
    ('green', 'red', 'yellow')
    >>> derender.simulate(scene, duration=0.2, remove="yellow", push="red:+x:50N@0.2s").fallen[0]
    'red'
    """
    if isinstance(scene, str | Path) and Path(scene).is_dir():
        scene = load(scene)  # type: ignore[assignment]
    posterior = scene if isinstance(scene, Posterior) else None
    found = scene.best if isinstance(scene, Posterior) else as_scene(scene)
    acts = Acts(push=push, remove=remove, add=add, tilt=tilt, shake=shake, jitter=jitter)
    once = intervention(**_several(acts))._replace(jitter=None)
    best = simulate_scene(found.graph, engine=engine, duration=duration, what=once, margin=margin, early=early)
    chance = Chance(float(best.stable), 0.0, 1)
    if draws and (posterior is not None or jitter):
        run = How(engine=engine, duration=duration, jobs=jobs, **acts)
        chance = chance_that("stands", posterior or found, draws, until, seed, **run)
    path = best.trajectory
    names = tuple(best.displacement) if path is None else path.names
    return Simulation(
        best.verdict, best.stable, chance.probability, chance.error, best.displacement, best.rotation, best.fallen,
        best.margin, np.zeros(0) if path is None else path.times,
        np.zeros((0, len(names), 4, 4)) if path is None else path.poses, names,
    )  # fmt: skip


def chance_that(
    event: Callable[[Outcome], bool] | str,
    of: Posterior | Scene,
    draws: int = 200,
    until: float | None = None,
    seed: int = 0,
    **how: Unpack[How],
) -> Chance:
    """Return how probable an event is, of a scene with jitter or of a posterior; see `Posterior.probability`."""
    count = draws if until is None else MOST_DRAWS
    rng = np.random.default_rng(seed)
    graphs = of.each_graph(rng, count) if isinstance(of, Posterior) else repeat(of.graph, count)
    missed = of.missed if isinstance(of, Posterior) else 0.0
    return probability(graphs, event, until=until, seed=seed, missed=missed, **_several(how))


def _several(acts: Mapping[str, Any]) -> dict[str, Any]:
    """Return interventions of which a single one may have been given in place of a sequence."""
    lists = ("push", "remove", "add")
    return {key: (text,) if key in lists and isinstance(text, str) else text for key, text in acts.items()}
