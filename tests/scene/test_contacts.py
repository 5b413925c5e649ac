"""Every contact by round trip and by brute-force geometry; whatever is registered is tested."""

import math

import numpy as np
import pytest
from geometry import (
    FLUSH,
    all_choices,
    contact_faults,
    face_axes,
    outline_gap,
    random_body,
    random_values,
    touching_set,
)

from derender.compilation.cache import interpreted
from derender.errors import DerenderError
from derender.scene import polygon
from derender.scene.contacts import contacts
from derender.scene.contacts.kinds import FaceToFace, SideOnFace
from derender.scene.pose import random_rotation, rotation_x
from derender.scene.separation import separation_of
from derender.scene.shapes import shapes
from derender.scene.solids import BOX

# Points of the child that must lie in the parent's plane: a box's face has four, an edge two, a corner one.
FLUSH_POINTS = {"face-to-face": 4, "edge-on-face": 2, "corner-on-face": 1}
KINDS = [name for name in contacts if name != "6dof"]


def flush_points(kind, child):
    return FLUSH_POINTS.get(kind) if shapes[child].solid_kind == BOX else None


def solid_arguments(body, pose):
    size = body.size()
    return body.shape.solid_kind, pose, np.zeros(3) if size is None else size


@pytest.mark.parametrize("kind", list(contacts))
def test_round_trip(kind):
    """phi -> pose -> phi, slack and all, for every choice of features; and any pose at all is reproduced."""
    rng = np.random.default_rng(1)
    for _, first, second, parent_face, child_face in all_choices(types=[kind]):
        parent, child = random_body(rng, first), random_body(rng, second)
        faces = parent, child, parent_face, child_face
        parameters = contacts[kind].parameters(parent.shape, child.shape, parent_face, child_face)
        values = random_values(rng, parameters, slack=0.2)
        if kind == "6dof":
            values.update(zip(("qw", "qx", "qy", "qz"), [0.5, 0.5, -0.5, 0.5], strict=True))
        pose = contacts[kind].relative_pose(values, *faces)
        found = contacts[kind].invert(pose, *faces)
        assert found.outside < 1e-12 and found.angle == 0.0
        for name, value in found.values.items():
            period = 2 * math.pi if name == "theta" else math.inf
            wrapped = abs(value - values.get(name, 0.0))
            # Inverse trigonometry and a division by the chord lose a few digits of the sixteen.
            assert min(wrapped, period - wrapped) < 1e-9, (first, second, parent_face, child_face, name)
        again = contacts[kind].relative_pose(found.values, *faces)
        assert np.abs(again - pose).max() < 1e-12


@pytest.mark.parametrize("kind", ["face-to-face", "point-on-face", "side-on-face"])
def test_any_rotation_is_reproduced_with_slack(kind):
    """These charts cover all rotations: where the outlines touch, slack takes up all that is left."""
    rng = np.random.default_rng(2)
    for _, first, second, parent_face, child_face in all_choices(types=[kind], parents=["plane"]):
        faces = random_body(rng, first), random_body(rng, second), parent_face, child_face
        pose = random_rotation(rng)
        pose[:3, 3] = rng.uniform(-0.2, 0.2, 3)
        found = contacts[kind].invert(pose, *faces)
        assert found.outside == 0.0 and found.angle == 0.0
        assert np.abs(contacts[kind].relative_pose(found.values, *faces) - pose).max() < 1e-12


def test_small_tilt_is_read_as_one_would_measure_it():
    rng = np.random.default_rng(3)
    faces = random_body(rng, "plane"), random_body(rng, "box"), "+z", "-z"
    contact = contacts["face-to-face"]
    pose = contact.relative_pose({"theta": 0.7, "x": 0.1, "y": -0.2}, *faces)
    tilted = rotation_x(0.03) @ pose
    found = contact.invert(tilted, *faces)
    assert found.phi["theta"] == pytest.approx(0.7, abs=0.03**2)
    assert math.hypot(found.slack["tilt_x"], found.slack["tilt_y"]) == pytest.approx(0.03, rel=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_touches_flush_without_interpenetration(kind):
    """Brute force: nothing of the child below the parent's face, something in it, the outlines meet, faces flush."""
    rng = np.random.default_rng(4)
    for _, first, second, parent_face, child_face in all_choices(types=[kind]):
        if second == "plane":
            continue  # a plane under a solid has no lowest point: test_plane_as_a_child
        parent, child = random_body(rng, first), random_body(rng, second)
        faces = parent, child, parent_face, child_face
        for _ in range(3):
            values = random_values(rng, contacts[kind].parameters(parent.shape, child.shape, parent_face, child_face))
            pose = contacts[kind].relative_pose(values, *faces)
            assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-12
            assert np.linalg.det(pose) == pytest.approx(1.0, abs=1e-12)
            assert contact_faults(pose, parent, child, parent_face, flush_points(kind, second)) == []
            # The 3-D separation of the two solids is nought, whichever way it is measured.
            apart = separation_of(*solid_arguments(parent, np.eye(4)), *solid_arguments(child, pose))
            assert abs(apart) < FLUSH


def test_plane_as_a_child():
    """A plane under a solid is the solid on the plane seen the other way round."""
    rng = np.random.default_rng(5)
    for kind, first, second, parent_face, child_face in all_choices(children=["plane"], types=["face-to-face"]):
        parent, child = random_body(rng, first), random_body(rng, second)
        values = random_values(rng, contacts[kind].parameters(parent.shape, child.shape, parent_face, child_face))
        pose = contacts[kind].relative_pose(values, parent, child, parent_face, child_face)
        centre, normal = face_axes(parent, parent_face)
        assert abs((pose[:3, 3] - centre) @ normal) < FLUSH
        sign = 1.0 if child_face[0] == "+" else -1.0
        assert np.abs(sign * pose[:3, 2] + normal).max() < FLUSH


def edge_cases():
    return [case for case in all_choices(types=KINDS) if shapes[case[1]].bounded and shapes[case[2]].bounded]


def test_at_the_ends_of_u_and_v_the_outlines_touch_in_an_edge_or_a_point():
    """At u or v of 0 or 1 the overlap has no area: gap nought. Just beyond the offsets they are apart; inside, over."""
    rng = np.random.default_rng(6)
    for kind, first, second, parent_face, child_face in edge_cases():
        parent, child = random_body(rng, first), random_body(rng, second)
        faces = parent, child, parent_face, child_face
        values = random_values(rng, contacts[kind].parameters(parent.shape, child.shape, parent_face, child_face))
        centre, normal = face_axes(parent, parent_face)
        own = touching_set(parent, np.eye(4), centre, -normal)

        def gap(u, v, values=values, faces=faces, own=own, centre=centre, normal=normal, kind=kind):
            pose = contacts[kind].relative_pose({**values, "u": u, "v": v}, *faces)
            return outline_gap(own, touching_set(faces[1], pose, centre, normal), normal)

        inner = rng.uniform(0.2, 0.8)
        for u, v in ((0.0, inner), (1.0, inner), (inner, 0.0), (inner, 1.0)):
            assert abs(gap(u, v)) < FLUSH, (kind, first, second, parent_face, child_face, u, v)
        for u, v in ((inner, -1e-3), (inner, 1 + 1e-3)):
            assert gap(u, v) > 1e-9
        if kind == "face-to-face":  # the other outlines have no area of their own: inside, the gap is nought too
            assert gap(0.5, 0.5) < -1e-3


def test_beyond_the_range_of_x_they_do_not_touch():
    rng = np.random.default_rng(7)
    for _ in range(100):
        parent, child = random_outline(rng), random_outline(rng)
        theta = rng.uniform(0, 2 * math.pi)
        half = interpreted(polygon.reach)(theta, *polygon.sides(parent, child))
        for x in (-half - 1e-6, half + 1e-6):
            for y in np.linspace(-0.3, 0.3, 13):
                assert brute_gap(parent, child, theta, x, y) > 1e-9


def random_outline(rng):
    a, b, r = rng.uniform(0.02, 0.1, 3)
    return [(a, b, 0.0), (0.0, 0.0, r), (a, 0.0, 0.0), (0.0, 0.0, 0.0)][rng.integers(4)]


def brute_gap(parent, child, theta, x, y):
    """Return the gap of two outlines in the plane from their corners."""

    def corners(outline):
        return np.array([[sx * outline[0] / 2, sy * outline[1] / 2, 0.0] for sx in (-1, 1) for sy in (-1, 1)])

    turn = np.array([[math.cos(theta), -math.sin(theta), 0], [math.sin(theta), math.cos(theta), 0], [0, 0, 1.0]])
    moved = corners(child) @ turn.T + [x, y, 0.0]
    return outline_gap((corners(parent), parent[2]), (moved, child[2]), np.array([0.0, 0.0, 1.0]))


def compiled(kernel):
    return kernel


BOTH_WAYS = pytest.mark.parametrize("run", [compiled, interpreted])


@BOTH_WAYS
def test_offsets_touch_exactly_within_the_polygon(run):
    """Membership in the Minkowski sum against brute force for every pair of outlines, anywhere in the plane."""
    rng = np.random.default_rng(8)
    inside = 0
    for _ in range(1500):
        parent, child = random_outline(rng), random_outline(rng)
        theta, (x, y) = rng.uniform(0, 2 * math.pi), rng.uniform(-0.12, 0.12, 2)
        sides = polygon.sides(parent, child)
        u, v, outside = run(polygon.uv_from_offset)(x, y, theta, *sides)
        gap = brute_gap(parent, child, theta, x, y)
        if abs(gap) > 1e-9:  # a point on the boundary may be called either
            assert (outside == 0.0) == (gap < 0.0)
        inside += outside == 0.0
        if outside == 0.0 and run(polygon.area_element)(u, theta, *sides) > 1e-9:
            again = run(polygon.offset_from_uv)(u, v, theta, *sides)
            assert np.allclose(again, (x, y), rtol=0, atol=1e-12)
    assert 200 < inside < 1300  # both answers were put to the test


@BOTH_WAYS
def test_area_element_integrates_to_the_area(run):
    """Over (u, v) it integrates to the Minkowski sum's area: |A| + |B| + mixed area, for two rectangles at theta."""
    (a, b), (c, d), theta = (0.1, 0.06), (0.08, 0.05), 0.4
    u = (np.arange(4000) + 0.5) / 4000
    area = np.mean([run(polygon.area_element)(x, theta, a, b, c, d, 0.0) for x in u])
    cosine, sine = math.cos(theta), math.sin(theta)
    mixed = a * (c * sine + d * cosine) + b * (c * cosine + d * sine)
    assert area == pytest.approx(a * b + c * d + mixed, rel=1e-5)  # midpoint rule with kinks: O(h^2)
    rounded = np.mean([run(polygon.area_element)(x, theta, a, b, 0.0, 0.0, 0.03) for x in u])
    assert rounded == pytest.approx(a * b + 2 * (a + b) * 0.03 + math.pi * 0.03**2, rel=1e-5)


@pytest.mark.parametrize("kind, sizes", [("face-to-face", {("cube", "cube"): 36, ("plane", "cube"): 12})])
def test_the_papers_contact_sets(kind, sizes):
    """Eqs. 2 and 3."""
    for (parent, child), count in {**sizes, ("cube", "plane"): 12, ("box", "cylinder"): 12}.items():
        assert len(contacts[kind].choices(shapes[parent], shapes[child])) == count

    def free_parameters(parent, child):
        return [p for p in contacts[kind].parameters(shapes[parent], shapes[child], "+z", "-z") if not p.slack]

    free = free_parameters("cube", "cube")
    assert [p.name for p in free] == ["theta", "u", "v"]
    assert [(p.lower, p.upper) for p in free] == [(0, math.pi / 2), (0, 1), (0, 1)]
    on_plane = free_parameters("plane", "box")
    assert [p.name for p in on_plane] == ["theta", "x", "y"] and on_plane[0].period == pytest.approx(math.pi)
    disc = free_parameters("box", "cylinder")
    assert [p.name for p in disc] == ["u", "v"]


def test_theta_repeats_with_the_period():
    """A period further on the child's solid is where it was: its points are the same set."""
    rng = np.random.default_rng(9)
    for kind, first, second, parent_face, child_face in all_choices(types=["face-to-face", "side-on-face"]):
        parent, child = random_body(rng, first), random_body(rng, second)
        if not child.shape.bounded:
            continue
        faces = parent, child, parent_face, child_face
        theta = contacts[kind].parameters(parent.shape, child.shape, parent_face, child_face)[0]
        poses = [contacts[kind].relative_pose({"theta": 0.3 + shift}, *faces) for shift in (0.0, theta.period)]
        rotations = child.shape.symmetry.rotations
        if child.shape.symmetry.axis is None:
            turned = [np.abs(poses[0][:3, :3] @ r - poses[1][:3, :3]).max() for r in rotations]
            assert min(turned) < 1e-12
        assert np.abs(poses[0][:3, 3] - poses[1][:3, 3]).max() < 1e-12


class Upright(FaceToFace):
    """Broken twin: the child's normal is not turned round, so it sits inside its parent."""

    def rotation(self, theta, first, second, child_face):
        return super().rotation(theta, first, second, child_face) @ rotation_x(math.pi)


class SquareOn(FaceToFace):
    """Broken twin: the intervals of Figure 2 at theta = 0 whatever theta is."""

    def relative_pose(self, values, parent, child, parent_face, child_face):
        faces = parent_face, child_face
        square = super().relative_pose({**values, "theta": 0.0}, parent, child, *faces)
        pose = super().relative_pose(values, parent, child, *faces)
        # Both faces' centres are on the child's axis, so the two poses' positions differ by the offset alone.
        pose[:3, 3] = square[:3, 3]
        return pose


class Sunken(SideOnFace):
    """Broken twin: the radius that lifts a lying cylinder is forgotten."""

    def relative_pose(self, values, parent, child, parent_face, child_face):
        return super().relative_pose(
            {**values, "gap": -child.face(child_face).lift}, parent, child, parent_face, child_face
        )


@pytest.mark.parametrize(
    "twin, child, values, fault",
    [
        (Upright(), "box", {"theta": 0.4, "u": 0.4, "v": 0.6}, "interpenetrates"),
        (SquareOn(), "box", {"theta": 0.8, "u": 0.01, "v": 0.01}, "misses"),
        (Sunken(), "cylinder", {"theta": 0.4, "u": 0.4, "v": 0.6}, "interpenetrates"),
    ],
)
def test_broken_twins_are_caught(twin, child, values, fault):
    rng = np.random.default_rng(10)
    parent, body = random_body(rng, "box"), random_body(rng, child)
    child_face = "side" if child == "cylinder" else "-z"
    pose = twin.relative_pose(values, parent, body, "+z", child_face)
    assert contact_faults(pose, parent, body, "+z") == [fault]


def test_gap_and_tilt_are_seen_by_the_brute_force():
    """The checks are sharp: a micrometre of gap or a microradian of tilt is found."""
    rng = np.random.default_rng(11)
    parent, child = random_body(rng, "box"), random_body(rng, "box")
    for slack, fault in (({"gap": 1e-6}, "hovers"), ({"gap": -1e-6}, "interpenetrates"), ({"tilt_x": 1e-6}, None)):
        pose = contacts["face-to-face"].relative_pose({"u": 0.5, "v": 0.5, **slack}, parent, child, "+z", "-z")
        faults = contact_faults(pose, parent, child, "+z", 4)
        assert faults == [fault] if fault else faults != []


def test_faults_are_one_line():
    contact, plane, cube = contacts["face-to-face"], shapes["plane"], shapes["cube"]
    for call, words in (
        (lambda: contact.default_choice(plane, plane), "a plane cannot be in face-to-face contact with a plane"),
        (lambda: contacts["6dof"].default_choice(cube, cube), "a cube cannot be in 6dof contact with a cube"),
        (lambda: contacts["face-to-fase"], "did you mean 'face-to-face'?"),
    ):
        with pytest.raises(DerenderError) as caught:
            call()
        assert words in str(caught.value) and "\n" not in str(caught.value)


def test_default_choice_is_bottom_on_top():
    assert contacts["face-to-face"].default_choice(shapes["plane"], shapes["box"]) == ("+z", "-z")
    assert contacts["side-on-face"].default_choice(shapes["box"], shapes["cylinder"]) == ("+z", "side")
    assert contacts["6dof"].default_choice(shapes["frame"], shapes["box"]) == (None, None)
