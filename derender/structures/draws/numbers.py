"""From draws of coordinates (chart.py) to a graph's numbers by address."""

import numpy as np

from derender.compilation.cache import address_of, call_for_two_numbers, njit
from derender.detection.solids.beliefs import BARE_IMAGE, Rules, bare_image
from derender.detection.solids.graph import TILTS, turns_freely
from derender.detection.solids.image import ROW, make_row
from derender.detection.solids.interpenetration import lowest
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.detection.solids.support import LEVEL
from derender.errors import DerenderError
from derender.scene.contacts import contacts
from derender.scene.contacts.compiled import FACE_TO_FACE, FEATURE_CODES, SIGNS, SLOTS, invert
from derender.scene.graph import ROOT, SceneGraph
from derender.scene.pose import inverse
from derender.scene.shapes import shapes
from derender.scene.solids import BOX, CYLINDER, PLANE, SPHERE
from derender.structures.draws.chart import (
    EQUAL,
    KIND,
    LEAST_EXTENT,
    Chart,
    camera_poses,
    log_prior,
    make_chart,
    place_rows,
    rows_at,
)

# How much of a full extent each shape's numbers are, and of which axis.
EXTENTS = {"cube": ((0, 1.0),), "box": ((0, 1.0), (1, 1.0), (2, 1.0)), "sphere": ((0, 0.5),),
           "cylinder": ((0, 0.5), (2, 1.0))}  # fmt: skip
GAP = 3  # place of a gap in phi
NO_PARENT = -2  # hangs on the root: 6dof in the floor's axes


def contact_numbers(
    chart: Chart, draws: np.ndarray, parents: np.ndarray, codes: np.ndarray, flush: np.ndarray,
    reaches: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return phi (n, N, SLOTS), extents (n, N, 3), floor to camera (n, 4, 4) float64 of draws (n, D) as contacts.

    parents : (N,) int64: index of a solid, FLOOR (-1) or NO_PARENT. codes : (N, 3) int64: contact, parent's and child's
        face. flush : (N,) bool, solids whose tilt is left out: their centres stay where they are, for with its foot
        held the top of one of 20 cm would be off by 7 mm at 2 degrees. reaches : (N,) bool, those whose gap is left out
        and that have a height of their own: they reach down to what bears them, for what is seen is the other end.
    """
    count, total = len(chart.flags), len(draws)
    phi, sizes = np.zeros((total, count, SLOTS)), np.zeros((total, 1 + count, 3))
    poses, kinds = np.empty((total, 1 + count, 4, 4)), np.array([PLANE, *chart.flags[:, KIND]], np.int64)
    code, size, numbers = np.int64(0), np.empty(3), np.empty(SLOTS)
    at = address_of(invert, code, code, size, code, size, code, code, np.empty((4, 4)), numbers)
    write_contacts(chart, draws, np.maximum(parents, FLOOR) + 1, codes, flush, reaches, kinds, at, phi, sizes,
                   poses)  # fmt: skip
    return phi, sizes[:, 1:], poses[:, 0]


@njit(cache=True, nogil=True)
def make_flush(on, own, parent_face, child_face):
    """Turn a pose (4, 4) about its place until its flat face lies against another pose's, in place."""
    against, face, about = np.zeros(3), np.zeros(3), np.empty(3)
    for i in range(3):
        for j in range(3):
            against[i] -= on[i, j] * SIGNS[parent_face, j]
            face[i] += own[i, j] * SIGNS[child_face, j]
    cosine = 0.0
    for i in range(3):
        about[i] = face[i - 2] * against[i - 1] - face[i - 1] * against[i - 2]
        cosine += face[i] * against[i]
    for j in range(3):  # of each axis a, a + about x a + about x (about x a) / (1 + cosine)
        x, y, z = own[0, j], own[1, j], own[2, j]
        along = (about[0] * x + about[1] * y + about[2] * z) / (1.0 + cosine)
        own[0, j] = cosine * x + about[1] * z - about[2] * y + about[0] * along
        own[1, j] = cosine * y + about[2] * x - about[0] * z + about[1] * along
        own[2, j] = cosine * z + about[0] * y - about[1] * x + about[2] * along


@njit(cache=True, nogil=True)
def reach_down(own, child_face, size, gap):
    """Move a face of a solid (size (3,), pose (4, 4) to camera) outwards by a gap, in place; the opposite one stays."""
    for j in range(3):
        sign = SIGNS[child_face, j]
        longer = max(size[j] + abs(sign) * gap, LEAST_EXTENT) - size[j] if sign != 0.0 else 0.0
        size[j] += longer
        for i in range(3):
            own[i, 3] += 0.5 * longer * sign * own[i, j]


@njit(cache=True, nogil=True)
def write_contacts(chart, draws, parents, codes, flush, reaches, kinds, inverse_at, phi, sizes, poses):
    """Write what each draw (D,) of (n, D) means as contacts, see `contact_numbers`; the floor is solid 0 of 1 + N.
    parents : (N,) int64. kinds : (1 + N,) int64. inverse_at : the address of `invert`. sizes : of zeros."""
    count = len(kinds) - 1
    rows, extents, relative = np.empty((count, ROW)), np.empty((count + 1, 3)), np.zeros((4, 4))
    relative[3, 3] = 1.0
    for n in range(len(draws)):
        place_rows(chart, draws[n], rows)
        camera_poses(chart, draws[n], rows, poses[n], extents)
        for k in range(1, count + 1):
            for i in range(3):
                sizes[n, k, i] = extents[k, i]
        for k in chart.order:
            on, own = poses[n, parents[k]], poses[n, k + 1]
            if flush[k]:
                make_flush(on, own, codes[k, 1], codes[k, 2])
            for i in range(3):
                for j in range(4):
                    shift = (own[0, 3] - on[0, 3], own[1, 3] - on[1, 3], own[2, 3] - on[2, 3])
                    x, y, z = shift if j == 3 else (own[0, j], own[1, j], own[2, j])
                    relative[i, j] = on[0, i] * x + on[1, i] * y + on[2, i] * z
            call_for_two_numbers(inverse_at, codes[k, 0], kinds[parents[k]], sizes[n, parents[k]], kinds[k + 1],
                                 sizes[n, k + 1], codes[k, 1], codes[k, 2], relative, phi[n, k])  # fmt: skip
            if reaches[k]:
                reach_down(own, codes[k, 2], sizes[n, k + 1], phi[n, k, GAP])


def numbers_of_draws(chart, draws, graph, names):
    """Return (addresses, values (n, P), root poses (n, 4, 4)) of draws (n, D) of the graph's structure.
    names : of the solids in the chart's order. Slack, and how a standing cylinder or a sphere is turned, are left out.
    """
    count = len(names)
    parents, codes = np.empty(count, np.int64), np.empty((count, 3), np.int64)
    flush, reaches = np.zeros((2, count), bool)
    for k, name in enumerate(names):
        vertex = graph.vertex(name)
        contact = vertex.contact
        above = NO_PARENT if vertex.parent == ROOT else FLOOR
        parents[k] = names.index(vertex.parent) if vertex.parent in names else above
        codes[k] = (contacts[contact.type].compiled_code, FEATURE_CODES[contact.parent_face],
                    FEATURE_CODES[contact.child_face])  # fmt: skip
        flush[k] = codes[k, 0] == FACE_TO_FACE and not set(TILTS) & set(contact.values)
        reaches[k] = flush[k] and "gap" not in contact.values and not chart.flags[k, EQUAL]
    phi, sizes, root = contact_numbers(chart, np.ascontiguousarray(draws), parents, codes, flush, reaches)
    found: dict[str, np.ndarray] = {}
    for k, name in enumerate(names):
        vertex = graph.vertex(name)
        contact = vertex.contact
        for parameter, (axis, share) in zip(shapes[vertex.shape].parameters, EXTENTS[vertex.shape], strict=True):
            found[f"{name}.{parameter.name}"] = share * sizes[:, k, axis]
        for slot, parameter in enumerate(graph.contact_parameters(name)):
            if parameter.name in contact.values and not (parameter.name == "theta" and turns_freely(vertex)):
                found[f"{name}.contact.{parameter.name}"] = phi[:, k, slot]
    addresses = tuple(a for a in graph.numbers() if a in found)
    values = np.stack([found[a] for a in addresses], axis=1) if addresses else np.empty((len(draws), 0))
    return addresses, values, root


def scene_log_prior(graph: SceneGraph, rules: Rules | None = None) -> float:
    """Return the log density of a scene of boxes, cubes, cylinders and spheres over one floor.
    Raises DerenderError : there is no floor, or more than one, or a solid of another kind."""
    state, floor_pose = state_of(graph)
    chart, values = make_chart(state, floor_pose, Rules(bare_image().loose.slack) if rules is None else rules)
    return float(log_prior(chart, rows_at(chart, values)))


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
