"""Several runs on one image as one posterior: its chains are all of theirs."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from derender.errors import DerenderError
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.graph import ROOT
from derender.scene.pose import inverse


def merge_runs(posteriors: Sequence[Posterior], names: Sequence[str]) -> Posterior:
    """Return several posteriors of the same scene as one with the chains of all, cut to the shortest.

    Of each its most probable structure counts. Where runs found the floor in a bare image each for itself, what stands
    on it is told in the first one's frame.

    names : of the runs, for what is said of them.

    Raises DerenderError : their unknowns differ.
    """
    parts = [posterior.best_part for posterior in posteriors]
    first = parts[0]
    for part, name in zip(parts, names, strict=True):
        if part.addresses != first.addresses:
            raise DerenderError(f"its structure or unknowns are not those of {names[0]}", name,
                                "report them one by one")  # fmt: skip
    draws = min(part.values.shape[1] for part in parts)
    parts = [as_seen_from(first, part) for part in parts]
    roots = [part.root_pose for part in parts if part.root_pose is not None]
    joined = replace(
        first,
        values=np.concatenate([part.values[:, :draws] for part in parts]),
        log_prior=np.concatenate([part.log_prior[:, :draws] for part in parts]),
        log_likelihood=np.concatenate([part.log_likelihood[:, :draws] for part in parts]),
        root_pose=np.concatenate([pose[:, :draws] for pose in roots]) if len(roots) == len(parts) else None,
        weight=1.0,
    )
    return replace(posteriors[0], parts=(joined,))


def as_seen_from(first: StructurePosterior, part: StructurePosterior) -> StructurePosterior:
    """Return a part with x, y (metres) and theta (radians) on its floor told in the frame of another part's floor.

    The two are taken to be one plane: by how much they differ in height and tilt is left out. A floor or a root whose
    pose has addresses of its own is another in each draw: then all stays as it is.
    """
    floors = [vertex for vertex in part.graph.vertices if vertex.shape == "plane"]
    if len(floors) != 1 or any(address.startswith(("root.", f"{floors[0].name}.")) for address in part.addresses):
        return part
    floor = floors[0].name
    here, there = part.graph.poses(), first.graph.poses()
    change = inverse(there[floor]) @ here[floor]
    if np.array_equal(change, np.eye(4)):
        return part
    values = part.values.copy()
    for vertex in part.graph.vertices:
        addresses = [f"{vertex.name}.contact.{key}" for key in ("x", "y", "theta")]
        if vertex.parent != floor or vertex.contact.parent_face != "+z" or not set(addresses) <= set(part.addresses):
            continue
        places = [part.addresses.index(address) for address in addresses]
        x, y, theta = np.moveaxis(part.values[:, :, places], -1, 0)
        points = np.stack([x, y, np.zeros_like(x), np.ones_like(x)], -1) @ change.T
        turn = np.arctan2(change[1, 0], change[0, 0])
        values[:, :, places] = np.stack([points[..., 0], points[..., 1], theta + turn], -1)
    roots = part.root_pose
    if roots is not None:  # so that each draw's poses are what they were
        own, other = inverse(here[ROOT]) @ here[floor], inverse(there[ROOT]) @ there[floor]
        roots = roots @ own @ inverse(change) @ inverse(other)
    return replace(part, values=values, root_pose=roots)
