"""A wrong camera is told by angles that should be right ones, and a right one is never called wrong."""

from dataclasses import replace

import numpy as np
import pytest
from on_floor import on_floor

from derender.camera.intrinsics import Camera
from derender.interface.functions import infer
from derender.render.raycast.depth import render_depth
from derender.results.fit import fit_of
from derender.results.focal_length import faces_in, faces_of, pixels_of, wrong_camera
from derender.scene.graph import Contact, Vertex

CAMERA = Camera.from_field_of_view(160, 120)


def seen(turns, elevation=35.0, sigma=0.002, upright=True):
    """Return a scene of boxes turned by so many degrees and its depth image with noise (H, W)."""
    boxes = []
    for k, turn in enumerate(turns):
        numbers = {"x": 0.17 * (k - 0.5 * (len(turns) - 1)), "y": 0.02 * k, "theta": float(np.radians(turn))}
        contact = Contact("face-to-face", "+z", "-z", numbers)
        if not upright:
            contact = Contact("edge-on-face", "+z", "-x-z", {**numbers, "lean": float(np.radians(25.0))})
        size = {"length": 0.12, "width": 0.1, "height": 0.11 + 0.02 * k}
        boxes.append(Vertex(f"box_{k}", "box", size, "floor", contact))
    graph = on_floor(*boxes, elevation=elevation, distance=0.8, lower=0.05)
    depth = render_depth(graph.solids(), CAMERA)[0]
    return graph, np.where(depth < 4.0, depth, np.nan) + np.random.default_rng(0).normal(0.0, sigma, depth.shape)


def words_of(graph, observed, wrong):
    """Return what is said where the camera's focal length is `wrong` times the true one."""
    taken = replace(CAMERA, fx=wrong * CAMERA.fx, fy=wrong * CAMERA.fy)
    faces = faces_of(graph, fit_of(graph, CAMERA, observed, {}), CAMERA, observed)
    return [doubt.words for doubt in wrong_camera(faces, taken)]


@pytest.mark.parametrize("turns", [(30,), (30, 30), (10, 55), (0, 20, 70)])
@pytest.mark.parametrize("upright", [True, False])
def test_the_right_focal_length_is_not_doubted(turns, upright):
    assert words_of(*seen(turns, upright=upright), 1.0) == []
    assert words_of(*seen(turns, upright=upright, sigma=0.006), 1.0) == []


@pytest.mark.parametrize("turns", [(30, 30), (10, 55), (0, 20, 70)])
@pytest.mark.parametrize("wrong", [0.8, 1.25])
def test_a_wrong_camera_is_told_and_which_would_be_right(turns, wrong):
    (words,) = words_of(*seen(turns), wrong)
    told = float(words.split(" is ")[1].split(" times")[0])
    assert told == pytest.approx(1.0 / wrong, rel=0.05)
    assert f"pixels and not {CAMERA.fx * wrong:.0f}:" in words


def test_a_wall_beyond_the_floors_horizon_is_no_part_of_it():
    """The floor's normal was fitted through both: three of ten low views with the right focal length were doubted."""
    graph, _ = seen((10, 55), elevation=7.0)
    clean = fit_of(graph, CAMERA, np.ones(CAMERA.shape), {"background": 10.0}).predicted
    observed = clean + np.random.default_rng(0).normal(0.0, 0.002, clean.shape)
    faces = faces_of(graph, fit_of(graph, CAMERA, observed, {"background": 10.0}), CAMERA, observed)
    floor = faces[0].plane * [CAMERA.fx, CAMERA.fy, 1.0]
    assert abs(floor @ graph.down()) / np.linalg.norm(floor) > np.cos(np.radians(1.0))  # which is of length 1
    assert wrong_camera(faces, CAMERA) == []
    assert wrong_camera(faces, replace(CAMERA, fx=1.25 * CAMERA.fx, fy=1.25 * CAMERA.fy))


def test_pixels_that_are_not_square_are_heeded():
    graph, observed = seen((10, 55))
    wide = replace(CAMERA, fx=2.0 * CAMERA.fx, cx=2.0 * CAMERA.cx, width=2 * CAMERA.width)
    observed = np.repeat(observed, 2, axis=1)
    faces = faces_of(graph, fit_of(graph, wide, observed, {}), wide, observed)
    assert wrong_camera(faces, wide) == []
    assert wrong_camera(faces, replace(wide, fx=1.3 * wide.fx, fy=1.3 * wide.fy))


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [0.8, 1.25])
def test_what_is_inferred_with_a_wrong_camera_is_not_trusted(wrong):
    _, observed = seen((10, 55), sigma=0.001)
    posterior = infer(observed, camera=replace(CAMERA, fx=wrong * CAMERA.fx, fy=wrong * CAMERA.fy))
    assert not posterior.trusted and any("focal length" in words for words in posterior.doubts)


@pytest.mark.slow
def test_a_box_that_a_wrong_focal_length_makes_a_free_form_thing_is_not_trusted():
    _, observed = seen((30,), sigma=0.001)
    posterior = infer(observed, camera=replace(CAMERA, fx=1.38 * CAMERA.fx, fy=1.38 * CAMERA.fy))
    assert not posterior.trusted and any("focal length is 0.7" in words for words in posterior.doubts)


@pytest.mark.parametrize("elevation", [20.0, 35.0, 55.0])
def test_a_things_planes_are_faces_whatever_the_focal_length_and_what_is_bent_has_none(elevation):
    graph, observed = seen((30,), elevation)
    fit = fit_of(graph, CAMERA, observed, {})
    mask = (fit.label == graph.names.index("box_0") + 1) & np.isfinite(observed)
    faces = [face for face in faces_in(*pixels_of(mask, CAMERA, observed), fit) if face is not None]
    assert len(faces) == 3 and wrong_camera(faces, CAMERA) == []
    (doubt,) = wrong_camera(faces, replace(CAMERA, fx=1.38 * CAMERA.fx, fy=1.38 * CAMERA.fy))
    assert "focal length is 0.7" in doubt.words
    contact = Contact("face-to-face", "+z", "-z", {"x": 0.0, "y": 0.0, "theta": 0.0})
    can = on_floor(Vertex("can", "cylinder", {"radius": 0.05, "height": 0.12}, "floor", contact),
                   elevation=elevation, distance=0.8, lower=0.05)  # fmt: skip
    depth = render_depth(can.solids(), CAMERA)[0] + np.random.default_rng(0).normal(0.0, 0.002, CAMERA.shape)
    side = fit_of(can, CAMERA, depth, {}).label == can.names.index("can") + 1
    faces = [face for face in faces_in(*pixels_of(side, CAMERA, depth), fit) if face is not None]
    assert len(faces) <= 1  # its end


@pytest.mark.parametrize("turns", [(30, 30), (10, 55)])
def test_that_cx_and_cy_are_the_middle_of_the_image_is_told(turns):
    graph, observed = seen(turns)
    fit = fit_of(graph, CAMERA, observed, {})
    swapped = replace(CAMERA, cx=CAMERA.cy, cy=CAMERA.cx)
    moved = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [swapped.cx - CAMERA.cx, swapped.cy - CAMERA.cy, 1.0]])
    (doubt,) = wrong_camera([face.about(moved) for face in faces_of(graph, fit, CAMERA, observed)], swapped)
    assert doubt.serious and "middle, 79.5, 59.5, and not 59.5, 79.5:" in doubt.words
    # of a part of an image they lie aside, and it is right so
    part = replace(CAMERA, width=100, cx=CAMERA.cx - 20.0)
    seen_of_it = fit_of(graph, part, observed[:, 20:120], {})
    assert wrong_camera(faces_of(graph, seen_of_it, part, observed[:, 20:120]), part) == []


def test_that_no_box_tells_the_focal_length_is_worth_knowing_where_it_was_given():
    (note,) = wrong_camera([], CAMERA, given=True)
    assert not note.serious and "no box is seen" in note.words
    assert wrong_camera([], CAMERA) == []


def test_where_neither_floor_nor_box_shows_there_are_no_faces():
    graph, observed = seen((30,))
    nothing = fit_of(graph, CAMERA, observed, {})._replace(explained=np.zeros(observed.shape, bool),
                                                           label=np.zeros(observed.shape, np.uint16))  # fmt: skip
    assert faces_of(graph, nothing, CAMERA, observed) == []
