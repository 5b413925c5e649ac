"""The functions of `import derender`: read, draw, render, infer and simulate, in plain Python."""

import sys
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np

from derender.camera import depth_file
from derender.camera.depth_file import DepthImage, with_up
from derender.camera.intrinsics import Camera
from derender.document import Document, graph_data, read_prior_document
from derender.interface.posterior import MOST_DRAWS, Posterior
from derender.interface.scene import Scene
from derender.interface.words import in_python, in_pythons_words
from derender.physics.intervention import intervention
from derender.physics.outcome import chance_of_one, probability, simulate_scene
from derender.posterior.forward import HEIGHT, WIDTH, draw_documents, observe
from derender.registry import only_its_keywords
from derender.render.renderers import find_renderer
from derender.results import posterior as kept
from derender.scene.graph import SceneGraph

read_depth = in_pythons_words(depth_file.read_depth)


@only_its_keywords
def load(path: str | Path) -> Scene | Document | Posterior:
    """Return what a file or folder holds: a Scene, a prior, or a Posterior.

    path : a scene file, a prior file or the name of a built-in prior, a folder that `derender infer` wrote, or what
        `save` of any of these wrote.

    Raises DerenderError : there is none of them.

    >>> import derender
    >>> derender.load(derender.data_path("scenes/figure-3-free.yaml"))
    <Scene: floor, green, red, yellow>
    >>> derender.load("tabletop").camera.width
    160
    """
    if Path(path).is_dir():
        image = Path(path) / "observation.npz"
        return Posterior.of(kept.load(path), read_depth(image) if image.is_file() else None)
    if Path(path).suffix == ".npz" or Path(path).is_file() and zipfile.is_zipfile(path):
        return Posterior.of(kept.load(path), None)
    document = read_prior_document(path)
    return _scene_of(document) if document.is_scene else document


@only_its_keywords
def sample(
    prior: str | Path | Document = "tabletop", *, seed: int = 0, camera: Camera | str | Path | None = None
) -> Scene:
    """Return a scene drawn from a prior: the one that `derender sample PRIOR --seed SEED` writes.

    prior : a prior file, the name of a built-in one, or what `load` returned.
    seed : of the random numbers. camera : or its file, instead of the prior's own.

    >>> import derender
    >>> derender.sample("stack", seed=3).parents["yellow"]
    'red'
    """
    document = prior if isinstance(prior, Document) else read_prior_document(prior)
    (drawn,) = draw_documents(document, 1, seed, {})
    return Scene(drawn.graph, as_camera(camera) or drawn.camera, drawn.likelihood)


@only_its_keywords
def render(
    scene: Scene | SceneGraph | str | Path,
    camera: Camera | str | Path | None = None,
    *,
    noise: bool = False,
    seed: int = 0,
    renderer: str = "raycast",
) -> DepthImage:
    """Return the depth image of a scene: (H, W) float64 metres along the optical axis, NaN where nothing is hit.

    scene : a Scene, a scene graph or a scene file.
    camera : or its file, instead of the scene's own; where there is neither, 160 x 120 pixels and 60 degrees.
    noise : whether noise, blur and outliers are drawn from the scene's likelihood. seed : of these.
    renderer : "raycast", or "pyrender" (OpenGL).

    >>> import derender
    >>> image = derender.render(derender.sample("stack", seed=0), derender.Camera.from_field_of_view(64, 48))
    >>> image.depth.shape
    (48, 64)
    """
    scene = as_scene(scene)
    camera = as_camera(camera) or scene.camera or Camera.from_field_of_view(WIDTH, HEIGHT)
    depth, _ = find_renderer(renderer).render_depth(scene.graph.solids(), camera)
    if noise:
        depth = observe(np.random.default_rng(seed), depth, scene.likelihood)
    return DepthImage(depth, camera)


@in_pythons_words
@only_its_keywords
def infer(
    image: DepthImage | np.ndarray | Sequence[Sequence[float]] | str | Path,
    *,
    camera: Camera | Mapping[str, float] | np.ndarray | Sequence[Sequence[float]] | str | Path | None = None,
    depth_scale: float | None = None,
    up: str | Sequence[float] | np.ndarray | None = None,
    prior: str | Path | Document | None = None,
    known: str | Path | Mapping[str, Any] | Sequence[Mapping[str, Any]] | Scene | None = None,
    only_known: bool = False,
    method: str = "auto",
    quick: bool = False,
    shapes: Sequence[str] | None = None,
    max_objects: int | None = None,
    floor: str | Sequence[float] | np.ndarray | None = None,
    allow_interpenetration: bool = False,
    allow_floating: bool = False,
    assume_stable: bool = False,
    chains: int | None = None,
    draws: int | None = None,
    warmup: int | None = None,
    budget: str | float | None = None,
    jobs: int = 1,
    seed: int = 0,
    progress: Callable[[float, str], None] | None = None,
) -> Posterior:
    """Infer the scene behind a depth image.

    image : a DepthImage; a file; or an array (H, W): floats are metres, uint16 are units of `depth_scale` millimetres;
        0 and NaN are pixels without a return. Depth is along the optical axis.
    camera : of an array or a file: a Camera, its file, a mapping of fx, fy, cx, cy, or a 3 x 3 matrix of intrinsics.
        Without one, 60 degrees of horizontal field of view are assumed.
    depth_scale : millimetres for one unit of an array of integers.
    up : upwards in camera axes (x right, y down, z forward), three numbers or an axis such as "-y"; None: the camera's.
    prior : a scene file with distributions or a built-in prior; None: all is found from the image.
    known : a library of known objects: its file, what stands in it as a mapping such as {"brick": {"type": "box",
        "length": 0.2, "width": "10 cm", "height": 0.06, "count": 2}}, a list of such objects, or a Scene of which each
        object is there at most once; only_known : there is nothing else.
    method : "auto", "map", "mcmc" or "smc"; quick : the best scene alone, as method="map".
    shapes, max_objects : to look for. floor : "auto", "none" or (a, b, c, d) of its plane in camera axes, metres.
    allow_interpenetration, allow_floating : whether solids may enter each other or hang in the air. assume_stable :
        whether what could not stand by itself is ruled out.
    chains, draws, warmup, jobs : how much is drawn, in how many processes. seed : the same seed gives the same draws.
    budget : seconds, or a time such as "30s" or "2min", after which draws of a bare image that do not agree yet are not
        gone on with.
    progress : called with (fraction done, what is being done).

    Raises DerenderError : something is wrong with the image, the camera or the prior. TypeError : an unknown keyword.

    >>> import derender
    >>> image = derender.sample(seed=1).render(noise=True)
    >>> posterior = derender.infer(image, quick=True)
    >>> posterior.best.names[0]
    'floor'
    >>> derender.infer(image, drawz=100)
    Traceback (most recent call last):
    ...
    TypeError: infer() has no keyword 'drawz'; did you mean 'draws'?
    """
    from derender.report.result_folder import judged
    from derender.structures.options import Options, seconds_of
    from derender.workflow import check_request, infer_image, look_at

    if quick and method not in ("auto", "map"):
        raise TypeError("infer(): quick=True is method='map'; leave one of them out")
    options = Options(
        method="map" if quick else method, quick=quick, seed=seed, chains=chains, draws=draws, warmup=warmup,
        budget=seconds_of(budget), jobs=jobs, shapes=shapes, max_objects=max_objects, floor=floor,
        known=_library(known), only_known=only_known, may_overlap=allow_interpenetration, may_float=allow_floating,
        assume_stable=assume_stable,
    )  # fmt: skip
    document = prior if isinstance(prior, Document | None) else read_prior_document(prior)
    if not isinstance(image, DepthImage):
        image = read_depth(image, camera, depth_scale)
    elif camera is not None or depth_scale is not None:
        raise TypeError("infer(): a DepthImage has its camera and metres; leave camera and depth_scale out")
    else:  # a program may have put anything into it
        read = read_depth(image.depth, image.camera)
        image = read._replace(camera_is_guess=image.camera_is_guess or read.camera_is_guess, meta=image.meta)
    seen = look_at(image if up is None else with_up(image, up), document, "image", _warn)
    check_request(options, document, prior, _warn)
    posterior, likelihood = infer_image(seen, document, options, progress=progress, warn=_warn)
    return Posterior.of(judged(posterior, seen, likelihood, page=False).posterior, seen)


def _library(known: str | Path | Mapping[str, Any] | Sequence[Mapping[str, Any]] | Scene | None) -> Any:
    """Return what `Options` take for a library of known objects."""
    from derender.structures.known.library import read_library

    if isinstance(known, Scene):
        entries = graph_data(known.graph)["objects"]
        known = {name: {**entries[name]["shape"], "count": 1} for name in known.sizes}
    elif not isinstance(known, str | Path | Mapping | None):
        if not all(isinstance(each, Mapping) for each in known):
            raise TypeError(
                'infer(): known is a list of what are no objects; give such as {"type": "cube", "side": 0.1}'
            )
        known = {str(each.get("name", f"known_{k}")): {key: each[key] for key in each if key != "name"}
                 for k, each in enumerate(known, start=1)}  # fmt: skip
    return known if known is None else read_library(known)


def _warn(line: str) -> None:
    """Warn of something at the line, outside of this package, that called it."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("derender."):
        level, frame = level + 1, frame.f_back
    warnings.warn(in_python(line), stacklevel=level)


def as_camera(camera: Camera | str | Path | None) -> Camera | None:
    """Return the Camera that a Camera or its file is; None stays."""
    return Camera.from_file(camera) if isinstance(camera, str | Path) else camera


def as_scene(scene: Scene | SceneGraph | str | Path) -> Scene:
    """Return the Scene that a Scene, a scene graph or a scene file is."""
    if isinstance(scene, Scene):
        return scene
    return Scene(scene) if isinstance(scene, SceneGraph) else _scene_of(read_prior_document(scene))


def _scene_of(document: Document) -> Scene:
    return Scene(document.graph, document.camera, document.likelihood)


class Acts(TypedDict, total=False):
    """Interventions, as texts that `derender simulate --help` explains, directions in the root's axes.

    push : such as "red:+x:0.5N@0.1s"; remove : names; add : such as "new:box:10x5x5cm@red"; one text or several each.
    tilt : of the floor, "10deg:+x". shake : of the floor, "2Hz:5mm:+x".
    jitter : "2mm,1deg", standard deviations by which each draw displaces and turns every object, what touches along
        the contact.
    """

    push: str | Sequence[str]
    remove: str | Sequence[str]
    add: str | Sequence[str]
    tilt: str | None
    shake: str | None
    jitter: str | None


class Simulation(NamedTuple):
    """What physics says of a scene or a posterior.

    verdict : "stands", "settles" or "falls", of the (most probable) scene. stable : whether it stands.
    p_stable : how probable standing is, p_stable_error : its Monte Carlo error; of a scene alone 1 or 0, and 0. Of what
        a posterior may have missed (`Posterior.missed`) no draw tells: half of that counts as standing.
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


@in_pythons_words
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
    once = intervention(**acts)._replace(jitter=None)
    best = simulate_scene(found.graph, engine=engine, duration=duration, what=once, margin=margin, early=early)
    missed = 0.0 if posterior is None else posterior.missed
    chance = chance_of_one(best.stable, missed=missed)
    if draws and (jitter or (posterior is not None and posterior.uncertain)):
        count = draws if until is None else MOST_DRAWS
        rng = np.random.default_rng(seed)
        graphs = repeat(found.graph, count) if posterior is None else posterior.each_graph(rng, count)
        chance = probability(
            graphs, "stands", until=until, seed=seed, engine=engine, duration=duration, jobs=jobs, missed=missed, **acts
        )
    path = best.trajectory
    names = tuple(best.displacement) if path is None else path.names
    return Simulation(
        best.verdict, best.stable, chance.probability, chance.error, best.displacement, best.rotation, best.fallen,
        best.margin, np.zeros(0) if path is None else path.times,
        np.zeros((0, len(names), 4, 4)) if path is None else path.poses, names,
    )  # fmt: skip
