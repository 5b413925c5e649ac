"""Statics against closed forms, a linear programme and the towers."""

import numpy as np
import pytest
from test_simulate import FLOOR, GRAVITY, cube, in_frame, matter, real_towers, towers_as_matter

from derender.physics.balance import BALANCED
from derender.physics.bodies import Body
from derender.physics.statics import ROLLING, Equilibrium, find_contacts
from derender.scene.pose import random_rotation, rotation_x, rotation_y, rotation_z, translation

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.05


def margin(*bodies, **more):
    return Equilibrium(matter(FLOOR, *bodies, **more)).margin()[0]


def test_a_block_slides_at_its_friction_and_topples_at_its_slenderness():
    assert margin(cube("a", 0, 0.05, friction=0.37)) == pytest.approx(0.37, rel=0.01)
    assert margin(cube("a", 0, 0.05, friction=2.0)) == pytest.approx(1.0, rel=0.01)
    tall = Body("tall", "box", np.array([0.05, 0.08, 0.2]), translation(0, 0, 0.1) @ rotation_z(0.4))
    assert margin(tall) == pytest.approx(0.25, rel=0.01)
    can = Body("can", "cylinder", np.array([0.06, 0.06, 0.15]), translation(0, 0, 0.075))
    assert margin(can) == pytest.approx(0.4, rel=0.02)  # the rim is drawn with 24 corners
    ball = Body("ball", "sphere", np.full(3, 0.1), translation(0, 0, 0.05))
    assert margin(ball) == pytest.approx(2 * ROLLING / np.sqrt(2), rel=0.01)
    assert margin() == 4.0 and margin(cube("a", 0, 0.3)) == 0.0


def test_what_does_not_touch_has_a_margin_of_its_own():
    """All together, 100 separate cubes took 85 s."""
    tall = Body("tall", "box", np.array([0.05, 0.08, 0.2]), translation(-1, 0, 0.1))
    tower = [cube("low", -2, 0.05), cube("high", -1.99, 0.15)]
    many = [cube(f"c{k}", 0.2 * k, 0.05) for k in range(60)]
    assert margin(*many[:30], tall, *tower, *many[30:]) == pytest.approx(margin(tall))
    assert margin(*many, *tower) == pytest.approx(margin(*tower)) and margin(*tower) > margin(tall)
    found = Equilibrium(matter(FLOOR, *many, *tower))
    assert sorted(map(len, found._islands())) == [1] * 60 + [2]


@pytest.mark.parametrize(("slope", "friction"), [(0.3, 0.4), (0.4, 0.4), (0.35, 0.4), (0.39, 0.4)])
def test_friction_cones_are_round(slope, friction):
    """A block on a slope of tangent t, in any direction, stays exactly where t is below its friction."""
    for angle in (0.0, 0.3, 0.7):
        down = 9.81 * np.array([slope * np.cos(angle), slope * np.sin(angle), -1.0]) / np.hypot(1, slope)
        found = Equilibrium(matter(FLOOR, cube("a", 0, 0.05, friction=friction), gravity=down))
        assert found.stands is (slope < friction * 1.0005)


@pytest.mark.parametrize(("overhang", "stands"), [(0.0, True), (0.0495, True), (0.0505, False), (0.09, False)])
@pytest.mark.parametrize("kind", ["box", "cylinder", "mesh", "sphere"])
def test_a_solid_stands_until_its_centre_leaves_its_support(kind, overhang, stands):
    top = Body("top", kind, np.full(3, 0.1), translation(overhang, 0, 0.15), CORNERS if kind == "mesh" else None)
    scene = matter(FLOOR, cube("low", 0, 0.05), top)
    frame = translation(0.1, 0.2, 0.9) @ rotation_x(-2.1) @ rotation_y(0.4)
    for each in (scene, in_frame(scene, frame)):
        found = Equilibrium(each)
        assert found.stands is stands and set(found.unbalanced()) <= {"low", "top"}


def test_gaps_and_overlaps_of_the_graph_are_contacts_and_others_are_none():
    for gap in (-0.004, 0.0, 0.004):
        tower = (FLOOR, cube("a", 0, 0.05 + gap), cube("b", 0.01, 0.15 + 2 * gap))
        assert Equilibrium(matter(*tower, supports=[("a", "floor"), ("b", "a")])).stands
        assert Equilibrium(matter(*tower)).stands is (gap <= 0)


def test_forces_balance_weights_and_moments():
    rng = np.random.default_rng(1)
    bridge = Body("bridge", "box", np.array([0.3, 0.06, 0.04]), translation(0.02, 0, 0.12), mass=2.0)
    scene = matter(FLOOR, cube("left", -0.1, 0.05), cube("right", 0.1, 0.05), bridge)
    scene = in_frame(scene, translation(*rng.normal(size=3)) @ random_rotation(rng))
    found = Equilibrium(scene).forces()
    up = -scene.gravity / 9.81
    load = {f.by: np.dot(f.force, up) for f in found if f.body == "bridge"}
    # the centre lies .12 m from the left pier's middle and .08 from the right one's; where on each it bears is open
    assert sum(load.values()) == pytest.approx(2.0 * 9.81, rel=2e-3) and set(load) == {"left", "right"}
    moment = sum(np.cross(f.point - scene.bodies[3].pose[:3, 3], f.force) for f in found if f.body == "bridge")
    assert np.linalg.norm(moment) < 5e-3 * 2.0 * 9.81 * 0.3
    ground = sum(np.array(f.force) for f in found if f.by == "floor")
    np.testing.assert_allclose(ground, (2.0 + 2 * 0.5) * 9.81 * up, atol=0.05)


def test_verdicts_agree_with_a_linear_programme_over_the_same_contacts():
    """HiGHS over sixteen-sided cones: inner pyramids decide the same but where a cone's roundness matters."""
    from scipy.optimize import linprog

    rng = np.random.default_rng(5)
    agreed, standing = 0, 0
    for _ in range(40):
        bodies, height, x = [FLOOR], 0.0, 0.0
        for k in range(4):
            size = rng.uniform(0.04, 0.12, 3)
            x += rng.uniform(-0.035, 0.035)
            pose = translation(x, 0, height + size[2] / 2) @ rotation_z(rng.uniform(0, 3))
            bodies.append(Body(f"b{k}", "box", size, pose, friction=0.5))
            height += size[2]
        slope = rng.uniform(0, 0.25)
        scene = matter(*bodies, gravity=9.81 * np.array([np.sin(slope), 0, -np.cos(slope)]))
        found = Equilibrium(scene)
        first, second, arm_1, arm_2, normal, friction, weight = found.parts
        columns = []
        for p in range(len(first)):
            u = np.cross(normal[p], [0.3, 0.5, 0.8])
            u /= np.linalg.norm(u)
            v = np.cross(normal[p], u)
            for angle in np.arange(16) * np.pi / 8:
                ray = normal[p] + friction[p] * (np.cos(angle) * u + np.sin(angle) * v)
                column = np.zeros((len(weight), 6))
                for body, arm, sign in ((first[p], arm_1[p], 1), (second[p], arm_2[p], -1)):
                    if body >= 0:
                        column[body] += sign * np.concatenate([ray, np.cross(arm, ray)]) / weight[body]
                columns.append(column.ravel())
        slack = np.vstack([np.eye(found.load.size), -np.eye(found.load.size)])
        matrix = np.column_stack([np.array(columns).T, slack.T])
        cost = np.concatenate([np.zeros(len(columns)), np.ones(len(slack))])
        least = linprog(cost, A_eq=matrix, b_eq=found.load.ravel()).fun
        agreed += found.stands == (least < 3 * BALANCED)
        standing += found.stands
    assert 5 < standing < 35 and agreed >= 39


def test_margins_are_where_verdicts_change():
    rng = np.random.default_rng(2)
    for _ in range(5):
        tower = [cube(f"c{k}", *rng.uniform(-0.015, 0.015, 1), 0.05 + 0.1 * k) for k in range(4)]
        scene = matter(FLOOR, *tower)
        margin, way = Equilibrium(scene).margin()
        assert margin > 0.01 and abs(way @ GRAVITY) < 1e-9
        for share, stands in ((0.97, True), (1.03, False)):
            pushed = scene._replace(gravity=GRAVITY + 9.81 * share * margin * np.array(way))
            assert Equilibrium(pushed).stands is stands


def test_contacts_of_two_turned_boxes_are_the_polygon_that_both_share():
    top = Body("top", "box", np.full(3, 0.1), translation(0, 0, 0.15) @ rotation_z(np.pi / 4))
    contacts = find_contacts(matter(FLOOR, cube("low", 0, 0.05), top))
    shared = contacts.point[(contacts.first == 2) & (contacts.second == 1)]
    assert len(shared) == 8  # an octagon, at the height of the face
    np.testing.assert_allclose(shared[:, 2], 0.1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(shared[:, :2], axis=1), 0.05 * np.hypot(1, np.sqrt(2) - 1), atol=1e-9)
    crossed = Body("top", "box", np.full(3, 0.1), translation(0, 0, 0.05 + 0.1 * np.sqrt(2)) @ rotation_x(np.pi / 4))
    low = cube("low", 0, 0.0)._replace(pose=translation(0, 0, 0.05) @ rotation_y(np.pi / 4), fixed=True)
    found = find_contacts(matter(low, crossed._replace(pose=translation(0, 0, 0.05 + 0.1 * np.sqrt(2)) @ (
        rotation_x(np.pi / 4)))))  # fmt: skip
    np.testing.assert_allclose(found.point, [[0, 0, 0.05 + 0.05 * np.sqrt(2)]], atol=1e-9)


def test_two_hundred_block_towers_by_statics():
    towers = real_towers()
    right = [Equilibrium(scene).stands == t["stable"] for scene, t in zip(towers_as_matter(towers), towers)]  # noqa: B905
    assert sum(right) >= 199
