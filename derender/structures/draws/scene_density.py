"""The density that inference from a bare image gives a scene graph before it sees the image.

It is that of `chart.log_prior`, in the coordinates of the chart that has the graph's structure: it compares scenes of
one structure; different structures compare by integrals (see `structures/alternatives.py`).
"""

import numpy as np

from derender.detection.solids.beliefs import BARE_IMAGE, Rules, bare_image
from derender.detection.solids.image import ROW, make_row
from derender.detection.solids.interpenetration import lowest
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.detection.solids.support import LEVEL
from derender.errors import DerenderError
from derender.scene.graph import SceneGraph
from derender.scene.pose import inverse
from derender.scene.shapes import shapes
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE
from derender.structures.draws.chart import log_prior, make_chart, place_rows


def scene_log_prior(graph: SceneGraph, rules: Rules | None = None) -> float:
    """Return the log density of a scene of boxes, cubes, cylinders and spheres over one floor.

    Raises DerenderError : there is no floor, or more than one, or a solid of another kind.
    """
    state, floor_pose = state_of(graph)
    chart, values = make_chart(state, floor_pose, Rules(bare_image().loose.slack) if rules is None else rules)
    rows = np.empty((len(state), ROW))
    place_rows(chart, values, rows)
    return float(log_prior(chart, rows))


def state_of(graph: SceneGraph) -> tuple[State, np.ndarray]:
    """Return the State of a scene graph and the pose of its floor (4, 4), floor frame to camera."""
    floors = [name for name in graph.solid_names if shapes[graph.vertex(name).shape].solid_kind == PLANE]
    if len(floors) != 1:
        what = f"the scene has {len(floors) or 'no'} floor{'s' if len(floors) > 1 else ''}"
        raise DerenderError(what, remedy=f"the prior {BARE_IMAGE} is of scenes over one plane")
    poses = graph.poses()
    floor_pose = poses[floors[0]]
    up = inverse(floor_pose)
    state, places = State(), {floors[0]: FLOOR}
    for name in graph.solid_names:
        if name in places:
            continue
        vertex = graph.vertex(name)
        kind = shapes[vertex.shape].solid_kind
        if kind not in (BOX, CYLINDER, SPHERE):
            remedy = f"the prior {BARE_IMAGE} is of boxes, cubes, cylinders and spheres"
            raise DerenderError(f"{name} is a {vertex.shape}", remedy=remedy)
        pose = up @ poses[name]
        row = make_row(kind, pose[:3, :3], pose[:3, 3], vertex.body.size())
        form = UPRIGHT if kind == SPHERE or abs(pose[2, 2]) > LEVEL else FREE
        resting = vertex.parent in places and vertex.contact.values.get("gap", 0.0) == 0.0
        places[name] = len(state)
        parent = places.get(vertex.parent, FLOOR)
        state = state.add(row, form, vertex.shape == "cube", parent, lowest(row) if resting else np.nan)
    return state, floor_pose
