"""Whether what a posterior's file holds can be one: checked whole, before anything uses it."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.scene.contacts import contacts
from derender.scene.graph import ROOT, Constraint
from derender.scene.shapes import shapes
from derender.scene.vertex import is_name

LARGEST = 1e9  # of numbers in a scene: their squares can be added
WEIGHTS_SLIP = 1e-6  # by which the weights of all structures may miss one: they are kept to 16 digits


def check_header(header: Any, form: int) -> Mapping[str, Any]:
    """Return the header of a posterior's file; DerenderError where it lacks something or is of another version."""
    if not isinstance(header, Mapping):
        raise DerenderError("its header is no JSON object")
    if header.get("format") != form:
        raise DerenderError(f"its format is {header.get('format')!r}, this version reads {form}")
    parts = header.get("parts")
    if not isinstance(parts, list) or not parts or not all(isinstance(part, Mapping) for part in parts):
        raise DerenderError("it holds no structure")
    for key, kinds in (("seed", (int, type(None))), ("command", (str, type(None))), ("version", (str, type(None)))):
        if key not in header or not isinstance(header[key], kinds):
            raise DerenderError(f"its {key} is {header.get(key)!r}")
    if not isinstance(header.get("meta"), Mapping):
        raise DerenderError("its meta is no JSON object")
    _check_meta(header["meta"])
    for part in parts:
        _check_graph(part["graph"])
    return header


def _check_meta(meta: Mapping[str, Any]) -> None:
    """Refuse a camera that is none, and other kinds of values than those that are read of `meta`."""
    if "camera" in meta:
        Camera(**meta["camera"])
    for key, kind in (("likelihood", dict), ("existence", dict), ("doubts", list)):
        if not isinstance(meta.get(key, kind()), kind):
            raise DerenderError(f"its {key} is {meta[key]!r}")


def _check_graph(tree: Any) -> None:
    """Refuse names that no scene file could have, unknown types, and parents that are not there."""
    names = [vertex["name"] for vertex in tree["vertices"]]
    for name in names:
        if not is_name(name):
            raise DerenderError(f"{name!r} cannot name an object")
    if len(set(names)) < len(names):
        raise DerenderError("two objects have the same name")
    for vertex in tree["vertices"]:
        if vertex["shape"] not in shapes or vertex["contact"]["type"] not in contacts:
            raise DerenderError(f"{vertex['name']} has an unknown shape or contact")
        if vertex["parent"] not in (ROOT, *names) or not set(vertex["supports"]) <= set(names):
            raise DerenderError(f"{vertex['name']} stands on what is not there")
        _check_finite(vertex["name"], vertex["parameters"], vertex["contact"]["values"])
    for constraint in tree["constraints"]:
        Constraint(**constraint)
    pose = np.asarray(tree["root_pose"], float)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise DerenderError("its root has no pose")
    if len(tree["gravity"]) != 3 or not all(math.isfinite(value) for value in tree["gravity"]):
        raise DerenderError("its gravity is no vector")


def _check_finite(name: str, *numbers: Mapping[str, Any]) -> None:
    for table in numbers:
        for key, value in table.items():
            if not _is_number(value) or abs(value) > LARGEST:
                raise DerenderError(f"{name}.{key} is {value!r}")


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def check_parts(parts: Sequence[Any]) -> None:
    """Refuse StructurePosteriors whose arrays do not fit each other, or whose weights are no probabilities."""
    for part in parts:
        part.graph.check()
        names, unknowns = set(part.graph.names), len(part.addresses)
        for address in part.addresses:
            if not isinstance(address, str) or address.partition(".")[0] not in names | {"root", "likelihood"}:
                raise DerenderError(f"{address!r} is no number of its scene")
        if len(set(part.addresses)) < unknowns:
            raise DerenderError("an unknown stands twice")
        values = part.values
        if values.ndim != 3 or values.shape[2] != unknowns or not values.shape[0] * values.shape[1]:
            raise DerenderError(f"its draws have the shape {values.shape} for {unknowns} unknowns")
        arrays = [values, part.log_prior, part.log_likelihood]
        if part.log_prior.shape != values.shape[:2] or part.log_likelihood.shape != values.shape[:2]:
            raise DerenderError("its densities are not those of its draws")
        if part.root_pose is not None:
            if part.root_pose.shape != (*values.shape[:2], 4, 4):
                raise DerenderError("its root's poses are not those of its draws")
            arrays.append(part.root_pose)
        for array in arrays:
            if array.dtype.kind != "f" or not np.isfinite(array).all():
                raise DerenderError("it holds numbers that are not finite")
        if len(part.periods) not in (0, unknowns):
            raise DerenderError(f"it has {len(part.periods)} periods for {unknowns} unknowns")
        if any(period is not None and not (isinstance(period, float) and period > 0.0) for period in part.periods):
            raise DerenderError("a period is no length")
        if not isinstance(part.weight, (int, float)) or not 0.0 <= part.weight <= 1.0 + WEIGHTS_SLIP:
            raise DerenderError(f"a structure has the weight {part.weight!r}")
        interval = (0.0, 1.0) if part.weight_interval is None else part.weight_interval
        for what, ends, count in (("error", (part.weight_error,), 1), ("range", interval, 2)):
            if len(ends) != count or not all(map(_is_number, ends)):
                raise DerenderError(f"the {what} of a structure's weight is {ends!r}")
        if not isinstance(part.extras, Mapping):
            raise DerenderError("its extras are no JSON object")
    if sum(part.weight for part in parts) > 1.0 + len(parts) * WEIGHTS_SLIP:
        raise DerenderError("the weights of its structures exceed one")
