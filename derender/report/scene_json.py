"""A scene as JSON: the contract that `show --json` prints and every other command that speaks JSON reuses."""

from typing import Any

import numpy as np

from derender.results.objects import size_intervals
from derender.scene.graph import SceneGraph


def scene_json(graph: SceneGraph, posterior: Any = None) -> dict[str, Any]:
    """Return the scene in camera axes: objects with type, full extents, pose, parent, contact.

    Parameters
    ----------
    graph : the scene; with a posterior, its most probable one.
    posterior : adds `size_interval`, `probability` and `parent_probability` to each object, and `support_probability`
        to what may have a second support.

    Returns
    -------
    {"frame": "camera", "gravity": [gx, gy, gz] in m/s^2, "objects": [...]}, and of a posterior that was judged
    (results/trust.py) `explained`, `trusted` and `doubts`; of an object, `size` is the three full extents along its own
    axes in metres, None for what has none; `size_interval` their 90 % intervals, likewise; `pose` is 4x4 row-major,
    object to camera; `supports`, where there, names what it rests on besides its parent.
    """
    poses = graph.poses()
    intervals = size_intervals(posterior) if posterior is not None else {}
    objects = []
    for vertex in graph.vertices:
        size = vertex.body.size()
        contact: dict[str, Any] = {"type": vertex.contact.type}
        if vertex.contact.parent_face is not None:
            contact["parent_face"] = vertex.contact.parent_face
        if vertex.contact.child_face is not None:
            contact["child_face"] = vertex.contact.child_face
        contact.update({name: float(value) for name, value in vertex.contact.values.items()})
        entry: dict[str, Any] = {
            "name": vertex.name,
            "type": vertex.shape,
            "size": None if size is None else [float(side) for side in size],
            "pose": np.asarray(poses[vertex.name], dtype=float).tolist(),
            "parent": vertex.parent,
            "contact": contact,
        }
        if vertex.supports:
            entry["supports"] = list(vertex.supports)
        if posterior is not None:
            entry["size_interval"] = intervals.get(vertex.name)
            entry["probability"] = float(posterior.object_probability(vertex.name))
            entry["probability_error"] = float(posterior.object_probability_error(vertex.name))
            parents = posterior.parent_probability(vertex.name)
            entry["parent_probability"] = {name: float(share) for name, share in parents.items()}
            if supports := posterior.support_probability(vertex.name):
                entry["support_probability"] = {name: float(share) for name, share in supports.items()}
        objects.append(entry)
    meta = {} if posterior is None else posterior.meta
    judged = {key: meta[key] for key in ("explained", "trusted", "doubts") if key in meta}
    return {"frame": "camera", "gravity": graph.pull().tolist(), "objects": objects, **judged}
