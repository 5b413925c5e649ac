"""Where a moving camera was in all frames together, and by how much that is off in all of them alike."""

import films
import numpy as np
from films import CAMERA, FPS, at, film, start

from derender.scene.pose import inverse
from derender.tracking.passes import Pass, Smoother
from derender.tracking.path import (
    BAND,
    CAMERA_CHANGES,
    CAMERA_SPEED,
    DEFINED,
    SHAKES,
    change_between,
    changed,
    errors_of,
    smooth_path,
)
from derender.tracking.thing import MOVING, STILL
from derender.tracking.track import Recorder

FRAMES, STEP, ANCHOR = 16, 1 / 30, 5
ERRORS = np.repeat([0.004, 0.02], 3)  # metres and radians by which one image tells a view


def observed(rng, shake):
    """Return (truth, views as each image tells them, their precisions) of a camera whose accelerations are as the model
    says; the images of three frames tell nothing, and one view is known."""
    changes = shake * STEP**2 * np.repeat(CAMERA_CHANGES, 3) * rng.standard_normal((FRAMES, 6))
    way = np.repeat(CAMERA_SPEED, 3) * STEP * rng.standard_normal(6)
    views = [films.view()]
    for each in changes[1:]:
        views.append(changed(views[-1], way))
        way = way + each
    told = np.tile(np.diag(ERRORS**-2.0), (FRAMES, 1, 1))
    told[[ANCHOR, 9, 10, 11]] = 0.0
    off = ERRORS * rng.standard_normal((FRAMES, 6))
    off[ANCHOR] = np.repeat(DEFINED, 3) * rng.standard_normal(6)
    return np.array(views), np.array([changed(v, o) for v, o in zip(views, off, strict=True)]), told


def held(seeds, handed_on):
    """Return how often 90 % intervals hold by how much what rests seems to be slowed, where the errors of views are as
    `handed_on` (factor -> (T, 6, K)) has them."""
    time = np.arange(FRAMES) - (FRAMES - 1) / 2
    slowed = time**2 - np.mean(time**2)
    z = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truth, views, told = observed(rng, rng.choice(SHAKES))
        found = smooth_path(views, told, np.zeros((FRAMES, 6)), ANCHOR, STEP)
        off = np.array([change_between(*pair) for pair in zip(found.views, truth, strict=True)])
        errors = handed_on(found.factor)
        z.append(slowed @ off / np.linalg.norm(np.einsum("t,tik->ik", slowed, errors), axis=1))
    return np.mean(np.abs(z) < 1.645)


def each_alone(factor):
    """Return errors with the right spread in each frame that are independent of those in others."""
    errors = errors_of(factor)
    alone = np.zeros((FRAMES, 6, FRAMES, 6))
    for t, each in enumerate(errors):
        alone[t, :, t] = np.linalg.cholesky(each @ each.T)
    return alone.reshape(FRAMES, 6, -1)


def test_errors_of_views_are_as_large_and_as_alike_as_is_said():
    assert 0.86 < held(60, errors_of) < 0.94  # 360 numbers: .90, and more than two standard errors of .016


def test_errors_that_are_independent_in_each_frame_are_found_out():
    """The broken twin: the spread of each frame's errors is right, and not what it says of an acceleration."""
    assert held(60, each_alone) < 0.86


def swung(number, shift):
    """Return the floor's pose before a camera that goes sideways by `shift` metres a frame."""
    view = films.view()
    view[0, 3] -= shift * number
    return view


def smoothed(states=None):
    """Return a smoother of a film in which one box stands and another slides to rest before a moving camera, and the
    true views; states : (T, 2), what is thought of them."""
    sizes = [np.array([0.08, 0.06, 0.07]), np.array([0.07, 0.07, 0.06])]
    left = np.maximum(8 - np.arange(14), 0)
    paths = [[at(0.07, 0.05, 0.035, (0, 0, 0.4)), at(-0.04 - 0.0008 * n**2, -0.03, 0.03, (0, 0, 0.2))] for n in left]
    views = [swung(t, 0.003) for t in range(14)]
    frames, poses = film(np.random.default_rng(3), ["box", "box"], sizes, paths, views)
    beginning = start(["box", "box"], sizes, poses[0])
    recorder = Recorder(frames[0], CAMERA, beginning.copy(), -9.81 * films.view()[:3, 2], 1 / FPS, True)
    for frame in frames[1:]:
        recorder.advance(frame)
    smoother = Smoother(Pass(0, beginning, recorder, None), frames)
    if states is not None:
        smoother.states[:] = states
    return smoother, np.array(views) @ inverse(views[0])


def off_by(smoother, truth):
    """Return (T,) by how much a thing in the middle is off, metres, because the views are."""
    middle = films.view() @ np.array([0.0, 0.0, 0.0, 1.0])
    views = np.array([recorder.seen[n].view for _, recorder, n in smoother.rows])
    return np.linalg.norm((views @ middle - truth @ middle)[:, :3], axis=1)


def test_the_path_of_a_camera_is_better_known_from_all_frames_than_from_those_before():
    smoother, truth = smoothed()
    before = off_by(smoother, truth)
    smoother.smooth()
    after = off_by(smoother, truth)
    assert np.ptp(np.diff(after)) < 0.2 * np.ptp(np.diff(before)) and after.max() < 0.002
    assert all(recorder.seen[n].view_factor.shape == (BAND, 6) for _, recorder, n in smoother.rows)


def test_the_camera_does_not_follow_what_is_taken_to_rest_a_little_too_soon():
    """What stops moves by less than a frame shows: the camera followed it, and all that moved beside it was slowed."""
    states = np.full((14, 2), STILL, object)
    states[:5, 1] = MOVING  # it rests from frame 8 on
    states[:, 0] = [*[STILL] * 3, *[MOVING] * 8, *[STILL] * 3]  # nothing else tells where the camera is
    smoother, truth = smoothed(states)
    smoother.poses[5:, 1] = smoother.poses[10, 1]
    smoother._find_views()
    assert np.abs(np.diff(off_by(smoother, truth))).max() < 0.00015  # 5 mm a second; it was 10


def test_the_views_of_a_film_in_which_nothing_moves_are_mended_too():
    """A film was charged less for a thing that moved in it: only then were its views fitted to all frames."""
    sizes, paths = [np.array([0.08, 0.06, 0.07])], [[at(0.07, 0.05, 0.035, (0, 0, 0.4))]] * 6
    frames, poses = film(np.random.default_rng(3), ["box"], sizes, paths, [swung(t, 0.003) for t in range(6)])
    beginning = start(["box"], sizes, poses[0])
    recorder = Recorder(frames[0], CAMERA, beginning.copy(), -9.81 * films.view()[:3, 2], 1 / FPS, True)
    for frame in frames[1:]:
        recorder.advance(frame)
    found = Pass(0, beginning, recorder, None)
    cost = found.cost()
    Smoother(found, frames).smooth()
    assert found.cost() < cost and all(seen.view_factor.size for seen in recorder.seen)
