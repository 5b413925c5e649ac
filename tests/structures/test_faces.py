"""Where the faces of real solids are, given where they appear; and what that makes of the prior of a cube."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from derender.camera.intrinsics import Camera
from derender.detection.estimate import settings_for
from derender.detection.search.greedy import Settings
from derender.detection.solids.beliefs import CUBE, Rules, bare_image, log_density_at
from derender.detection.solids.image import ROW, make_row
from derender.detection.solids.interpenetration import highest, lowest
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State
from derender.scene.pose import rotation_x, rotation_z
from derender.scene.priors.bare_image import Shared
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.draws.chart import SIZE, apparent_cube_log_density, make_chart, place_rows
from derender.structures.draws.faces import at_median_unseen, true_faces

OFF = 0.003
COUNT = 4000
RULES = Rules(0.002, faces=OFF)


def rows_of(chart, values):
    """Return rows (n, N, ROW) of coordinates (n, D)."""
    rows = np.empty((len(values), len(chart.flags), ROW))
    for each, row in zip(values, rows, strict=True):
        place_rows(chart, each, row)
    return rows


@pytest.fixture(scope="module")
def drawn():
    """Return the rows (5, ROW) of a tower of four kinds with a box that leans beside it, and (COUNT, 5, ROW) draws."""
    state = State()
    state = state.add(
        make_row(BOX, rotation_z(0.4)[:3, :3], [0, 0, 0.04], [0.1, 0.12, 0.08]), UPRIGHT, False, FLOOR, 0.0
    )
    upside_down = rotation_x(np.pi)[:3, :3]
    state = state.add(make_row(CYLINDER, upside_down, [0, 0, 0.13], [0.08, 0.08, 0.1]), UPRIGHT, False, 0, 0.08)
    state = state.add(make_row(BOX, np.eye(3), [0, 0, 0.21], [0.06] * 3), UPRIGHT, True, 1, 0.18)
    state = state.add(make_row(SPHERE, np.eye(3), [0, 0, 0.27], [0.06] * 3), FREE, False, 2, 0.24)
    leaning = rotation_x(0.6)[:3, :3]
    state = state.add(make_row(BOX, leaning, [0.3, 0, 0.1], [0.05, 0.06, 0.07]), FREE, False, FLOOR, np.nan)
    chart, values = make_chart(state, np.eye(4), RULES)
    rng = np.random.default_rng(0)
    return rows_of(chart, values[None])[0], rows_of(chart, true_faces(rng, chart, np.tile(values, (COUNT, 1))))


def test_what_stands_stays_on_its_support(drawn):
    _, rows = drawn
    for draw in rows[:50]:
        assert lowest(draw[0]) == pytest.approx(0.0, abs=1e-12)
        for k in (1, 2, 3):
            assert lowest(draw[k]) == pytest.approx(highest(draw[k - 1]), abs=1e-12)


def test_shapes_stay_what_they_are(drawn):
    start, rows = drawn
    assert np.array_equal(rows[:, :, 1:10], np.broadcast_to(start[:, 1:10], rows[:, :, 1:10].shape))
    assert np.allclose(rows[:, 1, 13], rows[:, 1, 14])
    for k in (2, 3):
        assert np.ptp(rows[:, k, 13:16], axis=1).max() < 1e-12


def test_each_face_has_an_offset_of_its_own(drawn):
    """An extent is two faces' and spreads by the root of two; of a cube three pairs of faces tell the side."""
    start, rows = drawn
    spread = (rows[:, :, 13:16] - start[:, 13:16]).std(axis=0) / OFF
    error = 4 / np.sqrt(2 * COUNT)  # four standard errors of a standard deviation, relative
    root = np.sqrt(2)
    wanted = np.array([[root] * 3, [root] * 3, [root / np.sqrt(3)] * 3, [root] * 3, [root] * 3])
    assert np.abs(spread / wanted - 1).max() < error
    assert np.abs((rows[:, :, 13:16] - start[:, 13:16]).mean(axis=0)).max() < 4 * root * OFF / np.sqrt(COUNT)
    tops = rows[:, :2, 12] + 0.5 * rows[:, :2, 15]
    assert np.abs(tops.std(axis=0) / (root * OFF) - 1).max() < error  # over the floor, however many solids are below
    # the middle of a free extent moves by half the difference of two offsets
    middle = (rows[:, 4, 10:13] - start[4, 10:13]) @ start[4, 1:10].reshape(3, 3)
    assert np.abs(middle.std(axis=0) / (OFF / root) - 1).max() < error


def test_all_on_the_floor_share_its_offset():
    state = State()
    for x in (0.0, 0.2):
        row = make_row(BOX, np.eye(3), [x, 0, 0.04], [0.1, 0.12, 0.08])
        state = state.add(row, UPRIGHT, False, FLOOR, 0.0)
    chart, values = make_chart(state, np.eye(4), RULES)
    drawn = true_faces(np.random.default_rng(0), chart, np.tile(values, (COUNT, 1)))
    heights = drawn[:, chart.slots[:, SIZE + 2]]
    assert abs(np.corrcoef(heights.T)[0, 1] - 0.5) < 4 * 0.75 / np.sqrt(COUNT)  # half of each variance is the floor's


def test_only_images_of_real_sensors_have_it():
    assert Settings().for_correlation(0.2).rules.faces == 0.0
    assert Settings().for_correlation(0.8).rules.faces == bare_image().loose.faces == OFF
    coarse = bare_image()._replace(loose=replace(bare_image().loose, slack=0.004, slack_seen=0.007))
    slacks = [Settings(beliefs=coarse).for_correlation(r).rules.slack for r in (0.0, 0.2, 0.8)]
    assert slacks == [0.004, 0.004, 0.007]  # as the file has it of made and of real images
    chart, values = cube_chart(RULES._replace(faces=0.0))
    exact = chart._replace(resting=0.0)
    assert true_faces(np.random.default_rng(0), exact, values[None])[0] == pytest.approx(values, abs=1e-15)
    assert np.array_equal(true_faces(None, chart, values[None])[0], values), "the most probable offsets are none"


def test_what_stands_sinks_in_or_stands_over_by_a_little():
    """A box on a box, and a cube beside them: each height is off by its own contact's offset, tops stay where they are
    seen to be; nothing else is off."""
    state = State()
    for k, (x, z) in enumerate([(0.0, 0.04), (0.0, 0.12)]):
        row = make_row(BOX, np.eye(3), [x, 0, z], [0.1, 0.12, 0.08])
        state = state.add(row, UPRIGHT, False, FLOOR if k == 0 else 0, 0.08 * k)
    state = state.add(make_row(BOX, np.eye(3), [0.3, 0, 0.05], [0.1] * 3), UPRIGHT, True, FLOOR, 0.0)
    chart, values = make_chart(state, np.eye(4), RULES._replace(faces=0.0))
    assert chart.resting == bare_image().loose.resting == 3e-5
    drawn = true_faces(np.random.default_rng(0), chart, np.tile(values, (COUNT, 1)))
    rows = rows_of(chart, drawn)
    error = 4.0 / np.sqrt(2.0 * COUNT)  # of a standard deviation, once in 16,000
    assert drawn[:, chart.slots[0, SIZE + 2]].std() == pytest.approx(3e-5, rel=error)
    assert drawn[:, chart.slots[2, SIZE]].std() == pytest.approx(3e-5, rel=error)
    tops = rows[:, :2, 12] + 0.5 * rows[:, :2, 15]
    assert tops.std(axis=0) == pytest.approx(3e-5, rel=error), "the upper top does not sink with the lower one"
    moved = np.flatnonzero(drawn.std(axis=0) > 1e-12)
    assert set(moved) == {chart.slots[0, SIZE + 2], chart.slots[1, SIZE + 2], chart.slots[2, SIZE]}


def test_how_much_pixels_tell_that_err_together_is_in_the_file():
    """By the power of the file, between its limits: log odds are divided by the temper."""
    shared = Shared(power=1.2, least=0.3, most=0.6, columns=320.0)
    settings = Settings(beliefs=bare_image()._replace(loose=replace(bare_image().loose, shared=shared)))
    tempers = [settings.for_correlation(r).temper for r in (0.2, 0.5, 0.9)]
    assert tempers == pytest.approx([1.0, 3.0**1.2, 4.0**1.2])
    assert Settings().for_correlation(0.5).temper == pytest.approx(3.0**1.5)
    wide = SimpleNamespace(correlation=0.5, camera=Camera.from_field_of_view(640, 480))
    assert settings_for(settings, wide).temper == pytest.approx(4.0 * 3.0**1.2)


def cube_chart(rules=RULES):
    state = State().add(make_row(BOX, np.eye(3), [0, 0, 0.05], [0.1] * 3), UPRIGHT, True, FLOOR, 0.0)
    return make_chart(state, np.eye(4), rules)


@pytest.mark.parametrize("extents", [(0.1, 0.1, 0.1), (0.104, 0.097, 0.1), (0.05, 0.058, 0.053)])
def test_a_cube_appears_as_its_side_and_offsets_make_it(extents):
    """Against the integral over the side, by a sum."""
    (chart, _), sides = cube_chart(), np.linspace(0.02, 0.2, 200_001)
    logs = np.array([log_density_at(chart.sizes[CUBE, 0], side) for side in sides])
    for extent in extents:
        logs += -0.25 * ((extent - sides) / OFF) ** 2 - 0.5 * np.log(4.0 * np.pi * OFF**2)
    expected = np.logaddexp.reduce(logs) + np.log(sides[1] - sides[0])
    found = apparent_cube_log_density(chart, np.array(extents))
    assert found == pytest.approx(expected, abs=0.02)
    wider = chart._replace(faces=1.5 * OFF)  # the broken twin: other offsets than those that are drawn
    assert apparent_cube_log_density(wider, np.array(extents)) != pytest.approx(expected, abs=0.1)


def test_the_most_probable_cube_has_the_mean_of_the_extents_at_which_it_appears():
    chart, values = cube_chart()
    values[chart.slots[0, SIZE:]] = 0.099, 0.104, 0.097
    assert np.allclose(true_faces(None, chart, values[None])[0, chart.slots[0, SIZE:]], 0.1)


@pytest.mark.parametrize("place, axis, side", [((0.0, -0.32, 0.05), 1, -1.0), ((0.42, 0.0, 0.05), 0, 1.0)])
def test_a_face_beyond_the_border_is_said_as_far_as_half_of_the_draws_have_it(place, axis, side):
    """Seen from above at a metre the image ends at .4 and .3 m; one face of the box lies beyond, all others within."""
    state = State().add(make_row(BOX, np.eye(3), place, [0.2, 0.2, 0.1]), UPRIGHT, False, FLOOR, 0.0)
    floor = rotation_x(np.pi)
    floor[2, 3] = 1.0
    chart, values = make_chart(state, floor, RULES)
    camera = Camera(fx=100.0, fy=100.0, cx=39.5, cy=29.5, width=80, height=60)
    views = (SimpleNamespace(camera=camera, into=np.eye(4)),)
    drawn = np.tile(values, (101, 1))
    drawn[:, chart.slots[0, SIZE : SIZE + 3]] += np.linspace(0.0, 0.2, 101)[:, None]  # what is seen is not to follow
    before = rows_of(chart, values[None])[0, 0]
    after = rows_of(chart, at_median_unseen(SimpleNamespace(chart=chart, sensor=SimpleNamespace(views=views)), values,
                                            drawn)[None])[0, 0]  # fmt: skip
    wanted = np.array([0.2, 0.2, 0.1])
    wanted[axis] += 0.1
    assert after[13:16] == pytest.approx(wanted)
    faces = [row[10 + axis] - 0.5 * side * row[13 + axis] for row in (before, after)]
    assert faces[1] == pytest.approx(faces[0]) and after[10 + 1 - axis] == before[10 + 1 - axis]
