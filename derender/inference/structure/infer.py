"""From a bare depth image to a posterior over scene graphs: observe, propose, search, sample."""

import numpy as np

from derender.inference.structure.image import make_image
from derender.inference.structure.observation import observe, patches_of
from derender.inference.structure.proposals import all_hypotheses, make_surface
from derender.inference.structure.search import Settings, search, total_energy
from derender.inference.structure.support import final_parents


def point_estimate(rng, depth, camera, settings=None, widest=160):
    """Return (state, observation): the best explanation of a depth image (H, W) in metres, NaN = no return."""
    settings = Settings() if settings is None else settings
    seen = observe(rng, depth, camera, widest)
    settings = settings.for_correlation(seen.correlation)
    patches = patches_of(seen)
    typical = float(np.median(seen.footprint[seen.mask])) if seen.mask.any() else 0.005
    noise = float(np.median(seen.sigma[seen.mask])) if seen.mask.any() else 0.001
    surface = make_surface(seen.points, patches, seen.image.origin, typical, noise)
    state = search(rng, seen.image, all_hypotheses(surface, settings.shapes), settings)
    state.parents = final_parents(state)
    return state, seen


def infer_structure(image, camera, options=None, rng=None, progress=None):
    """Infer which solids are there and what rests on what.

    Parameters
    ----------
    image : (H, W) float metres, NaN or 0 = no return.
    camera : Camera, or a dict with fx, fy, cx, cy.
    options : mapping, all optional: shapes (names), max_objects, method ("map": the best scene only).
    rng : numpy Generator; progress : called with (fraction done, message), or None.

    Returns a Posterior.
    """
    from derender.inference.posterior import Posterior, StructurePosterior
    from derender.inference.structure.graph import scene_graph

    options = dict(options or {})
    rng = np.random.default_rng(options.get("seed")) if rng is None else rng
    settings = Settings()
    if options.get("shapes"):
        settings = settings._replace(shapes=tuple(options["shapes"]))
    if options.get("max_objects"):
        settings = settings._replace(max_objects=int(options["max_objects"]))
    if progress:
        progress(0.0, "finding the floor and the patches")
    depth = np.where(np.isfinite(image) & (image > 0), image, np.nan)
    state, seen = point_estimate(rng, depth, camera, settings)
    graph = scene_graph(state, seen.floor.pose)
    numbers = graph.numbers()
    addresses = tuple(a for a in numbers if not a.startswith("floor."))
    energy = total_energy(seen.image, state, settings)
    part = StructurePosterior(
        graph, addresses, np.array([numbers[a] for a in addresses]).reshape(1, 1, -1),
        np.zeros((1, 1)), np.full((1, 1), -energy),
    )  # fmt: skip
    if progress:
        progress(1.0, f"{len(state)} solids")
    return Posterior((part,), seed=options.get("seed"), meta={"reduced_by": seen.factor, "noise": seen.floor.sigma})


def draw_graph(graph, shape, camera):
    """Return (depth (H, W), label (H, W) int32 into names or negative, names) of a graph's solids over its floor."""
    from derender.inference.structure.image import FAR, ROW, draw, make_row

    names = [n for n in graph.solid_names if graph.vertex(n).shape != "plane"]
    floor = next(n for n in graph.solid_names if graph.vertex(n).shape == "plane")
    poses, solids = graph.poses(), graph.solids()
    image = make_image(np.zeros(shape), 1.0, camera, poses[floor])
    rows = np.empty((len(names), ROW))
    for k, name in enumerate(names):
        number = graph.solid_names.index(name)
        pose = np.linalg.inv(poses[floor]) @ poses[name]
        rows[k] = make_row(solids.kind[number], pose[:3, :3], pose[:3, 3], solids.size[number])
    depth, label = np.empty(shape), np.empty(shape, np.int32)
    draw(image, rows, -1, depth, label)
    return np.where(depth >= FAR, np.inf, depth), label, names
