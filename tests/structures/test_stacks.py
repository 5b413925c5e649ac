"""Stacks where neighbouring pixels share noise: two solids in place of one, or of a thing, if that is what is there."""

import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter
from table_scenes import CAMERA, bowl, seen_on_the_table

from derender.detection.compounds import FLUSH, arms
from derender.detection.estimate import settings_for
from derender.detection.search.greedy import Settings
from derender.detection.search.observation import CORRELATED, observe
from derender.detection.solids.image import make_row
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.detection.things import made_thing
from derender.scene.pose import rotation_x
from derender.scene.solids import BOX, CYLINDER, MESH
from derender.structures.stacks import badness, inexact, parts_of_one, with_stacks

# A can with a box on it: of what a solid hides of another nothing shows.
STACK = (CYLINDER, 0.0, 0.0, (0.08, 0.08, 0.06), None), (BOX, 0.01, 0.0, (0.05, 0.045, 0.11), None)


def seen_by_a_sensor(*solids):
    """Return the Observation of solids on the table whose neighbouring pixels share noise, and its Settings."""
    rng = np.random.default_rng(1)
    image = seen_on_the_table(solids)
    field = gaussian_filter(rng.standard_normal(image.shape), 1.5)
    seen = observe(image + 0.0015 * field / field.std(), CAMERA)
    assert seen.correlation > CORRELATED
    return seen, settings_for(Settings(), seen)


def as_thing(seen):
    """Return (Observation with all that stands on the floor as one thing, State without solids)."""
    thing = made_thing(seen, State(), seen.mask, (0.9, 0.05))
    floor = np.where(seen.mask, seen.image.depth, seen.image.floor)
    return seen._replace(things=(thing,), image=seen.image._replace(floor=floor)), State()


def as_can(seen, size):
    """Return (Observation, State of a can about where all that stands on the floor shows)."""
    x, y, _ = np.median(seen.points[seen.mask], axis=0)
    return seen, State().add(make_row(CYLINDER, np.eye(3), [x, y, 0.5 * size[2]], size), UPRIGHT, False)


def test_a_stack_that_the_search_tells_as_one_can_or_as_a_thing_is_two():
    """Of 24 images of three such sensors seven were trusted, with a stack as one cylinder or thing in it."""
    seen, settings = seen_by_a_sensor(*STACK)
    can = as_can(seen, (0.07, 0.07, 0.11))
    assert badness(*can)[1][0] > 2.0
    x, y, _ = can[1].rows[0, 10:13]
    tilted = State().add(make_row(BOX, rotation_x(0.3)[:3, :3], [x, y, 0.055], (0.06, 0.05, 0.1)), FREE, False)
    for there, state in (can, (seen, tilted), as_thing(seen)):
        left, found, refined = with_stacks(np.random.default_rng(0), there, state, settings)
        assert not left.things and found.parents == [FLOOR, 0] and refined is None
        assert found.rows[:, 0].tolist() == [CYLINDER, BOX]
        np.testing.assert_allclose(found.rows[:, 15], [0.06, 0.05], atol=0.006)  # their heights
        np.testing.assert_allclose(found.rows[0, 13], 0.08, atol=0.006)


def test_a_solid_where_nothing_stands_is_no_stack():
    """A wall of noise was told as a cylinder before the floor: none of its pixels showed what stands there."""
    seen, _ = seen_by_a_sensor(*STACK)
    off, state = as_can(seen, (0.07, 0.07, 0.11))
    off = off._replace(mask=np.zeros_like(seen.mask))
    assert badness(off, state)[1][0] > 2.0 and inexact(off, state, [0]) == []


def test_what_shows_beyond_a_solid_is_no_part_of_the_stack_in_its_place():
    """Beside the upper one, where the solid that stood for both hides it, the floor shows."""
    lower, upper = (0.1, 0.05, 0.06), (0.04, 0.03, 0.11)  # not flush on three sides, which would be one thing
    seen, settings = seen_by_a_sensor((BOX, 0.0, 0.0, lower, None), (BOX, 0.025, 0.0, upper, None))
    x, y, _ = np.quantile(seen.points[seen.mask], (0.02, 0.98), axis=0).mean(axis=0)
    box = make_row(BOX, np.eye(3), [x, y, 0.5 * upper[2]], (*lower[:2], upper[2]))
    _, found, _ = with_stacks(np.random.default_rng(0), seen, State().add(box, UPRIGHT, False), settings)
    assert found.parents == [FLOOR, 0]
    np.testing.assert_allclose(found.rows[:, 15], [0.06, 0.05], atol=0.006)  # their heights


def test_what_is_one_solid_or_no_solid_stays_so():
    seen, settings = seen_by_a_sensor((BOX, 0.0, 0.0, (0.07, 0.08, 0.11), None))
    for there, state in (as_can(seen, (0.08, 0.08, 0.11)), as_thing(seen)):
        left, found, refined = with_stacks(np.random.default_rng(0), there, state, settings)
        assert left is there and found is state and len(refined.state) == len(state)
    seen, settings = seen_by_a_sensor((MESH, 0.0, 0.0, (0.14, 0.14, 0.06), bowl()))
    left, found, _ = with_stacks(np.random.default_rng(0), *as_thing(seen), settings)
    assert len(left.things) == 1 and len(found) == 0


@pytest.mark.parametrize(("degrees", "size"), [(6.0, (0.07, 0.05, 0.16)), (4.0, (0.09, 0.04, 0.17))])
def test_a_carton_that_leans_is_no_stack(degrees, size):
    """Two upright ones, each a step farther, explained it 73 and 84 nats better than an upright one does."""
    carton = trimesh.creation.box(size)
    carton.apply_transform(rotation_x(np.radians(degrees)))
    mesh = carton.vertices.copy(), np.ascontiguousarray(carton.faces, np.int32)
    seen, settings = seen_by_a_sensor((MESH, 0.0, 0.0, tuple(carton.extents), mesh))
    x, y, _ = np.median(seen.points[seen.mask], axis=0)
    state = State().add(make_row(BOX, np.eye(3), [x, y, 0.5 * size[2]], size), UPRIGHT, False)
    _, found, _ = with_stacks(np.random.default_rng(0), seen, state, settings)
    assert len(found) == 1


def test_a_bottle_s_neck_and_an_l_s_arms_are_parts_of_one():
    """Two such solids explain a bottle, or an L, better than any one does, and are none for that."""

    def one(kind, lower, upper, x):
        rows = [make_row(kind, np.eye(3), np.array([along, 0.0, high + 0.5 * size[2]]), np.array(size))
                for along, high, size in ((0.0, 0.0, lower), (x, lower[2], upper))]  # fmt: skip
        state = State().add(rows[0], UPRIGHT, False, FLOOR, 0.0).add(rows[1], UPRIGHT, False, 0, lower[2])
        return parts_of_one(state, 0, FLUSH)

    can = (0.08, 0.08, 0.1)
    assert one(CYLINDER, can, (0.03, 0.03, 0.06), 0.002) and not one(CYLINDER, can, (0.03, 0.03, 0.06), 0.025)
    assert not one(CYLINDER, can, (0.06, 0.06, 0.06), 0.0)
    foot = (0.08, 0.045, 0.03)
    assert one(BOX, foot, (0.03, 0.045, 0.05), 0.024) and not one(BOX, foot, (0.03, 0.045, 0.05), 0.012)


@pytest.mark.parametrize(
    "size, middle, parent, expected",
    [((0.03, 0.045, 0.07), 0.055, FLOOR, True),  # beside the foot's end, as wide
     ((0.03, 0.045, 0.05), 0.025, 0, True),  # on its end
     ((0.03, 0.045, 0.05), 0.031, 0, True),  # as far as its end is seen
     ((0.03, 0.054, 0.07), 0.055, FLOOR, False),  # wider
     ((0.03, 0.045, 0.07), 0.07, FLOOR, False),  # 15 mm beside it
     ((0.03, 0.045, 0.05), 0.012, 0, False),  # not at its end
     ],
)  # fmt: skip
def test_two_boxes_that_are_flush_are_the_arms_of_an_l(size, middle, parent, expected):
    """Seven of fourteen L-shapes were told as two boxes, each at P .99, where the search found two."""
    foot = (0.08, 0.045, 0.03)
    bottom = foot[2] if parent == 0 else 0.0
    rows = [make_row(BOX, np.eye(3), np.array(place), np.array(extents)) for place, extents in
            (((0.0, 0.0, 0.015), foot), ((middle, 0.001, bottom + 0.5 * size[2]), size))]  # fmt: skip
    state = State().add(rows[0], UPRIGHT, False, FLOOR, 0.0).add(rows[1], UPRIGHT, False, parent, bottom)
    found = arms(state, FLUSH)
    assert (found is not None) == expected and (found is None or set(found) == {0, 1})
    if parent == FLOOR:
        assert arms(state.add(rows[1] + np.eye(1, len(rows[1]), 12)[0], UPRIGHT, False, 1, 0.08), FLUSH) is None


def test_two_boxes_of_one_kind_are_put_flush_on_purpose():
    size = np.array([0.08, 0.045, 0.03])
    lying, upright = (make_row(BOX, np.eye(3), np.array([x, 0.0, 0.5 * extents[2]]), extents)
                      for x, extents in ((0.0, size), (0.055, size[[2, 1, 0]])))  # fmt: skip
    state = State().add(lying, UPRIGHT, False, FLOOR, 0.0).add(upright, UPRIGHT, False, FLOOR, 0.0)
    assert arms(state, FLUSH) is None
