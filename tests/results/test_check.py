"""The posterior predictive check: what is wrong with a scene is told, and where; of a right one nothing is."""

from dataclasses import replace

import numpy as np
import pytest
from on_floor import cube, face, on_floor

from derender.camera.intrinsics import Camera
from derender.report.scene_json import scene_json
from derender.results.check import check_fit
from derender.results.fit import fit_of
from derender.results.posterior import Posterior, StructurePosterior
from derender.results.trust import Doubt, judgement, trusted, with_all_in_doubt
from derender.scene.graph import SceneGraph, Vertex
from derender.scene.pose import rotation_y, translation

CAMERA = Camera.from_field_of_view(160, 120)
LIKELIHOOD = {"sigma": 0.002, "blur": 0.5, "background": 10.0}


def scene(*solids):
    """Return a floor 0.9 m away, seen from 55 degrees above, with solids on it."""
    return on_floor(*solids, elevation=55.0, distance=0.9, lower=0.05)


TRUE = scene(cube("left", -0.2, theta=0.3), cube("right", 0.2, theta=0.3))


def image(graph, sigma=0.002):
    depth = fit_of(graph, CAMERA, np.ones(CAMERA.shape), LIKELIHOOD).depth.astype(float)
    return depth + np.random.default_rng(0).normal(0.0, sigma, depth.shape)


def doubts_of(graph, seen, likelihood=LIKELIHOOD, told=None):
    return check_fit(graph, fit_of(graph, CAMERA, seen, likelihood, told), CAMERA, seen, likelihood)


def test_a_right_scene_raises_no_doubt():
    assert doubts_of(TRUE, image(TRUE)) == ()
    assert doubts_of(TRUE, image(TRUE, 0.01), {**LIKELIHOOD, "sigma": 0.01}) == ()  # nor do noise and what is lost
    seen = image(TRUE)
    seen[np.random.default_rng(1).random(seen.shape) < 0.3] = np.nan
    assert doubts_of(TRUE, seen) == ()
    noisy = image(TRUE, 0.018)
    noisy[np.isnan(seen)] = np.nan  # no flat patch is whole: none shows how noisy the image is
    assert doubts_of(TRUE, noisy, {**LIKELIHOOD, "sigma": 0.018}) == ()


def test_a_thing_that_was_missed_is_told_and_where():
    (doubt,) = doubts_of(TRUE.remove("right"), image(TRUE))
    assert not doubt.about  # nothing touches it
    assert doubt.serious and "region A right of the middle" in doubt.words and "not explained" in doubt.words
    expected = fit_of(TRUE, CAMERA, image(TRUE), LIKELIHOOD).label == 3
    assert (doubt.regions[0].mask & expected).sum() > 0.8 * expected.sum()
    assert judgement([doubt], TRUE) == {"trusted": False, "doubts": [doubt.words], "in_doubt": []}


def test_an_answer_none_of_whose_objects_is_trusted_is_not_either():
    """A frame was trusted while each of its objects was in doubt for something of its own."""
    left, right = (Doubt(f"{name} may be clutter", False, about=(name,)) for name in ("left", "right"))
    assert with_all_in_doubt((left,), TRUE) == (left,) and trusted((left,))
    *before, last = with_all_in_doubt((left, right), TRUE)
    assert before == [left, right] and last.words == "each of the objects is in doubt" and not trusted((last,))
    assert judgement((left, right, last), TRUE)["in_doubt"] == ["left", "right"]
    assert with_all_in_doubt((), TRUE) == ()


def test_what_a_doubt_is_about_is_in_doubt_and_what_stands_on_it():
    """What is not explained apart from a solid says nothing of it; what touches it does."""
    seen = image(scene(*TRUE.vertices[1:], cube("touching", -0.2, -0.11, theta=0.3)))
    doubt, before = doubts_of(TRUE, seen)
    assert before.about == ("left",)  # it hides much of that
    assert doubt.serious and set(doubt.about) == {"left"}
    upon = Vertex("upon", "cube", {"side": 0.05}, "left", face(u=0.5, v=0.5, theta=0.0))
    stacked = replace(TRUE, vertices=(*TRUE.vertices, upon))
    assert judgement([doubt], stacked)["in_doubt"] == ["left", "upon"]
    assert judgement([Doubt("of all")], stacked)["in_doubt"] == ["floor", "left", "right", "upon"]
    assert judgement([Doubt("worth knowing", False)], stacked)["in_doubt"] == []
    part = StructurePosterior(stacked, (), np.zeros((1, 1, 0)), np.zeros((1, 1)), np.zeros((1, 1)))
    found = scene_json(stacked, Posterior((part,), meta=judgement([doubt], stacked)))
    assert {each["name"]: each["trusted"] for each in found["objects"]} == {
        "floor": True, "left": False, "right": True, "upon": False}  # fmt: skip


def test_what_is_seen_behind_the_floor_is_no_thing_that_was_missed():
    """A table's rim bends down: 1.2 % of the image, 15 mm below its plane, made a right answer untrusted."""
    seen, depth = image(TRUE), 0.9
    assert trusted(doubts_of(TRUE, seen))
    bent = seen.copy()
    bent[112:, 20:70] += 0.04 * depth
    (doubt,) = doubts_of(TRUE, bent)
    assert not doubt.serious and "2 % of the image is not explained" in doubt.words
    bent[112:, 20:70] = seen[112:, 20:70] - 0.04 * depth
    (doubt,) = doubts_of(TRUE, bent)
    assert doubt.serious
    bent = seen.copy()
    bent[96:] += 0.04 * depth  # so much of it speaks against the floor
    (doubt,) = doubts_of(TRUE, bent)
    assert doubt.serious


def test_windows_that_noise_does_not_explain_are_told():
    """A quick search built five boxes of four, none off by more than a sensor may be: it was trusted on its fit."""
    seen = image(TRUE)
    (doubt,) = check_fit(
        TRUE, fit_of(TRUE, CAMERA, seen, LIKELIHOOD), CAMERA, seen, LIKELIHOOD, [[0.4, 0.5, 0.75, 0.8]]
    )
    assert doubt.serious and doubt.words.startswith("what is seen right of the middle is not where this scene has it")
    assert doubt.regions[0].mask.sum() == 12 * 8 and doubt.regions[0].mask[48:60, 120:128].all()
    twice = [[0.4, 0.5, 0.75, 0.8], [0.45, 0.55, 0.75, 0.8]]
    (doubt,) = check_fit(TRUE, fit_of(TRUE, CAMERA, seen, LIKELIHOOD), CAMERA, seen, LIKELIHOOD, twice)
    assert len(doubt.regions) == 2 and "of the middle and" not in doubt.words  # two in one place are said once
    seen[:48] = 3.0  # a room behind
    fit = fit_of(TRUE, CAMERA, seen, LIKELIHOOD, seen)
    assert check_fit(TRUE, fit, CAMERA, seen, LIKELIHOOD, [[0.1, 0.2, 0.75, 0.8]]) == ()


def test_what_is_as_likely_an_object_as_not_and_is_not_told_is_doubted():
    seen = image(TRUE)
    fit, place = fit_of(TRUE, CAMERA, seen, LIKELIHOOD), [0.8, 0.9, 0.1, 0.2]
    (doubt,) = check_fit(TRUE, fit, CAMERA, seen, LIKELIHOOD, clutter=[[0.48, *place], [0.2, 0.1, 0.2, 0.1, 0.2]])
    assert not doubt.serious and "below and left of the middle is an object with a probability of 0.48" in doubt.words
    assert not doubt.about and doubt.regions[0].mask.sum() == 12 * 16
    assert check_fit(TRUE, fit, CAMERA, seen, LIKELIHOOD, clutter=[[0.4, *place]]) == ()


def test_a_solid_that_is_not_there_is_told():
    (doubt,) = [d for d in doubts_of(TRUE, image(TRUE.remove("right"))) if d.words.startswith("right ")]
    assert doubt.serious and "explains" in doubt.words


def test_an_opening_in_a_solid_is_told_of_it():
    """An arch's, through which the floor is seen: little of the image, but not of what was taken for a wall."""
    seen, behind = image(TRUE), image(TRUE.remove("left"))
    rows, columns = np.nonzero(fit_of(TRUE, CAMERA, seen, LIKELIHOOD).label == 2)
    for high, told in ((3, False), (8, True)):
        opening = np.s_[int(rows.mean()) : int(rows.mean()) + high, int(columns.mean()) : int(columns.mean()) + 6]
        arch = seen.copy()
        arch[opening] = behind[opening]
        serious = [doubt for doubt in doubts_of(TRUE, arch) if doubt.serious]
        assert [doubt.about for doubt in serious] == ([("left",)] if told else [])
        assert all("of what is seen where left should be is something else" in doubt.words for doubt in serious)


def test_a_ghost_where_nothing_returned_is_told():
    seen = image(TRUE)
    seen[fit_of(TRUE, CAMERA, seen, LIKELIHOOD).label == 3] = np.nan
    (doubt,) = doubts_of(TRUE, seen)
    assert doubt.serious and doubt.words.startswith("nothing returned from 100 % of right, right of the middle")


def test_where_few_pixels_return_everywhere_a_solid_that_returns_as_few_is_none():
    """Of depths put into an image three times as large "nothing returned from 90 %" of a box, and of all else."""
    seen = np.where(np.random.default_rng(1).random(image(TRUE).shape) < 0.09, image(TRUE), np.nan)
    assert not [doubt for doubt in doubts_of(TRUE, seen) if doubt.words.startswith("nothing returned")]


def test_noise_that_hides_a_solid_is_told():
    """The likelihood that explains a missed solid away is far above what flat patches show."""
    words = [d.words for d in doubts_of(TRUE.remove("right"), image(TRUE), {**LIKELIHOOD, "sigma": 0.06})]
    assert any("a noise of 60 mm was fitted where flat patches show" in each for each in words)
    words = [d.words for d in doubts_of(TRUE, image(TRUE), {**LIKELIHOOD, "sigma": 0.12})]
    assert any("a noise of 120 mm was" in each for each in words)  # no 1.2e+02 mm


def test_background_over_the_floor_is_no_explanation_and_beyond_it_says_nothing_of_what_is_on_it():
    empty = scene()
    seen = image(scene(cube("large", side=0.18, theta=0.3)))
    (doubt,) = doubts_of(empty, seen, told=seen)
    assert doubt.serious and doubt.words.startswith("what stands over the floor is taken as background: ")
    beside = image(scene(*TRUE.vertices[1:], cube("cut", 0.5, side=0.25, theta=0.3)))
    (doubt,) = doubts_of(TRUE, beside, told=beside)
    assert not doubt.serious and trusted([doubt])  # a cupboard that the border cuts
    (doubt,) = doubts_of(empty, beside, told=beside)
    assert doubt.serious  # all that is seen is cut, or not told
    behind = image(TRUE)
    behind[:48] = behind[102:] = 3.0  # a room about a table, in over half of the image
    assert doubts_of(TRUE, behind, told=behind) == ()


def test_what_the_border_cuts_is_worth_knowing_and_what_fills_the_view_is_serious():
    cut = scene(cube("cut", 0.4, side=0.15, theta=0.3))
    (doubt,) = doubts_of(cut, image(cut))
    assert not doubt.serious and "cut by the image's border" in doubt.words and trusted([doubt])
    half = scene(cube("half", 0.62, side=0.25, theta=0.3))
    (doubt,) = [d for d in doubts_of(half, image(half)) if "half is cut" in d.words]
    assert doubt.about == ("half",) and not doubt.serious
    filling = scene(cube("huge", side=0.6, theta=0.3))
    assert any(d.serious and "huge fills" in d.words for d in doubts_of(filling, image(filling)))


@pytest.mark.parametrize("shift", [0.0, 0.004, 0.03])
def test_a_shift_within_the_sensors_own_is_none(shift):
    moved = replace(TRUE, root_pose=translation(0.0, 0.0, shift) @ TRUE.root_pose)
    assert bool(doubts_of(moved, image(TRUE))) == (shift > 0.02)


def test_one_surface_that_fills_the_view_may_be_a_things():
    near = on_floor(elevation=70.0, distance=0.4)
    (doubt,) = doubts_of(near, image(near))
    assert doubt.serious and "nothing is seen but one surface" in doubt.words
    far = on_floor(elevation=70.0, distance=1.8)
    assert doubts_of(far, image(far)) == ()  # nothing is so wide
    assert doubts_of(TRUE, image(TRUE)) == ()


def test_range_instead_of_depth_is_told():
    seen = image(TRUE)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    ray = np.sqrt(1.0 + ((columns - CAMERA.cx) / CAMERA.fx) ** 2 + ((rows - CAMERA.cy) / CAMERA.fy) ** 2)
    assert any("range" in d.words for d in doubts_of(TRUE, seen * ray))


def test_a_floor_that_explains_less_than_the_background_is_doubted():
    seen = image(TRUE)
    fit = fit_of(TRUE, CAMERA, seen, LIKELIHOOD)
    nearer = (np.arange(120)[:, None] < 110) & (fit.label == 0)
    seen[nearer] -= 0.2
    told = np.where(nearer, seen, fit.depth)
    assert any("less than the background" in doubt.words for doubt in doubts_of(TRUE, seen, told=told))
    assert not any("less than the background" in doubt.words for doubt in doubts_of(TRUE, image(TRUE)))


@pytest.mark.parametrize(("lean", "told"), [(0.0, False), (8.0, False), (30.0, True), (180.0, True)])
def test_a_floor_that_is_not_level_as_given_is_doubted(lean, told):
    down = rotation_y(np.deg2rad(lean))[:3, :3] @ -TRUE.poses()["floor"][:3, 2]
    lean = np.degrees(np.arccos(-down @ TRUE.poses()["floor"][:3, 2]))
    seen, camera = image(TRUE), replace(CAMERA, gravity=tuple(down))
    doubts = check_fit(TRUE, fit_of(TRUE, CAMERA, seen, LIKELIHOOD), camera, seen, LIKELIHOOD)
    words = f"the floor leans by {lean:.0f} degrees against the way up that --up or the camera file says"
    assert [doubt.words.startswith(words) for doubt in doubts if doubt.serious] == [True] * told


@pytest.mark.parametrize("rows", [0, 110])
def test_a_floor_that_faces_sideways_is_doubted_unless_it_shows_nearly_everywhere(rows):
    """Of what a phone saw that was held in portrait all was doubted."""
    wall = SceneGraph(translation(0.3, 0.0, 0.9) @ rotation_y(np.deg2rad(-100)), on_floor().vertices)
    seen = image(wall)
    fit = fit_of(wall, CAMERA, seen, LIKELIHOOD)
    nearer = (np.arange(120)[:, None] < rows) & (fit.label == 0)
    seen[nearer] -= 0.2
    doubts = doubts_of(wall, seen, told=np.where(nearer, seen, fit.depth))
    assert [doubt.serious for doubt in doubts if "sideways" in doubt.words] == [rows > 0]


@pytest.mark.parametrize("distance, share, wall", [(2.2, 0.5, True), (2.2, 0.2, False), (0.9, 0.5, False)])
def test_a_floor_looked_at_from_afar_with_much_before_it_may_be_a_wall(distance, share, wall):
    """A shelf before a wall was trusted: the wall was a floor on which it lay."""
    straight = on_floor(elevation=90.0, distance=distance)
    seen = image(straight)
    before = np.tile(np.arange(120)[:, None] < share * 120, (1, 160))
    seen[before] -= 0.4
    told = np.where(before, seen, distance)
    assert any("may be a wall" in doubt.words for doubt in doubts_of(straight, seen, told=told)) == wall


@pytest.mark.parametrize("sigma", [0.0, 0.01])
def test_one_depth_far_away_is_no_floor_without_anything_on_it(sigma):
    """What a sensor clips at ten metres looks like a floor right below a camera, also where something
    is nearer, as the floor right before the camera."""
    flat = on_floor(elevation=90.0, distance=10.0)
    seen = 10.0 + sigma * np.random.default_rng(0).standard_normal(CAMERA.shape)
    near = np.where(np.arange(120)[:, None] < 100, seen, seen - 2.0)
    for depth, told in ((seen, None), (near, near)):
        words = [doubt.words for doubt in doubts_of(flat, depth, told=told) if doubt.serious]
        assert any(each.startswith("the floor is one depth of 10 m") for each in words)
    slanted = on_floor(elevation=70.0, distance=10.0)
    assert doubts_of(slanted, image(slanted, max(sigma, 0.002))) == ()
