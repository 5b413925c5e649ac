"""Several runs on one image as one posterior: its chains are all of theirs."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from derender.errors import DerenderError
from derender.inference.posterior import Posterior, StructurePosterior
from derender.model.pose import inverse


def merged(posteriors: Sequence[Posterior], names: Sequence[str]) -> Posterior:
    """Return several posteriors of the same scene as one with the chains of all, cut to the shortest.

    Of each its most probable structure counts. Where runs found the floor in a bare image each for itself, what stands
    on it is told in the first one's frame.

    Parameters
    ----------
    names : of the runs, for what is said of them.

    Raises
    ------
    DerenderError : their unknowns differ.
    """
    parts = [posterior.best_part for posterior in posteriors]
    first = parts[0]
    for part, name in zip(parts, names, strict=True):
        if part.addresses != first.addresses:
            raise DerenderError(f"its structure or unknowns are not those of {names[0]}", name,
                                "report them one by one")  # fmt: skip
    draws = min(part.values.shape[1] for part in parts)
    joined = replace(
        first,
        values=np.concatenate([values_as_seen_from(first, part)[:, :draws] for part in parts]),
        log_prior=np.concatenate([part.log_prior[:, :draws] for part in parts]),
        log_likelihood=np.concatenate([part.log_likelihood[:, :draws] for part in parts]),
        root_pose=None if first.root_pose is None else np.concatenate([part.root_pose[:, :draws] for part in parts]),
        weight=1.0,
    )
    return replace(posteriors[0], parts=(joined,))


def values_as_seen_from(first: StructurePosterior, part: StructurePosterior) -> np.ndarray:
    """Return a part's values (chains, draws, P) with x, y (metres) and theta (radians) on planes in another's frame.

    The planes are taken to be one: how much they differ in height and tilt is left out. A plane that is itself unknown
    is another in each draw: what stands on it stays as it is.
    """
    values = part.values.copy()
    here, there = part.graph.poses(), first.graph.poses()
    known = [plane.name for plane in part.graph.vertices if plane.shape == "plane" and part.root_pose is None
             and not any(address.startswith(f"{plane.name}.") for address in part.addresses)]  # fmt: skip
    for vertex in part.graph.vertices:
        addresses = [f"{vertex.name}.contact.{key}" for key in ("x", "y", "theta")]
        if vertex.parent not in known or not set(addresses) <= set(part.addresses):
            continue
        change = inverse(there[vertex.parent]) @ here[vertex.parent]
        if vertex.contact.parent_face != "+z" or np.array_equal(change, np.eye(4)):
            continue
        places = [part.addresses.index(address) for address in addresses]
        x, y, theta = np.moveaxis(part.values[:, :, places], -1, 0)
        points = np.stack([x, y, np.zeros_like(x), np.ones_like(x)], -1) @ change.T
        turn = np.arctan2(change[1, 0], change[0, 0])
        values[:, :, places] = np.stack([points[..., 0], points[..., 1], theta + turn], -1)
    return values
