"""What a filter could not know while it went through a film is mended once its end is known."""

import films
import numpy as np
import pytest
from films import CAMERA, FPS, at, errors, film, start

from derender.tracking.passes import Fit, Pass, Passes, Smoother
from derender.tracking.thing import MOVING, STILL
from derender.tracking.track import Recorder

GRAVITY = -9.81 * films.view()[:3, 2]
SIZE = np.array([0.08, 0.06, 0.07])
BEGINS, ENDS, FRAMES = 3, 9, 14


def slide(seed):
    """A box rests, slides by 8 mm a frame, and rests again."""
    moved = [0.008 * (min(max(t, BEGINS), ENDS) - BEGINS) for t in range(FRAMES)]
    paths = [[at(-0.03 + x, 0, 0.035, (0, 0, 0.4 + 4 * x))] for x in moved]
    return film(np.random.default_rng(seed), ["box"], [SIZE], paths)


def followed(frames, beginning):
    """Return the pass of the filter alone."""
    recorder = Recorder(frames[0], CAMERA, beginning.copy(), GRAVITY, 1 / FPS)
    for frame in frames[1:]:
        recorder.advance(frame)
    return Pass(0, beginning, recorder, None)


def track_of(found):
    return found.track(np.arange(FRAMES) / FPS, [str(t) for t in range(FRAMES)])


def test_a_size_that_was_wrong_at_first_is_that_of_all_frames_in_all_of_them():
    frames, poses = slide(0)
    off = np.array([0.004, -0.003, 0.0])
    found = Passes(frames, CAMERA, GRAVITY, 1 / FPS, lambda _: start(["box"], [SIZE + off], poses[0])).best()
    sizes = track_of(found).sizes[:, 0]
    assert np.ptp(sizes, axis=0).max() == 0.0
    assert np.abs(sizes[0] - SIZE)[:2].max() < 0.001  # an eighth of a pixel; no outline tells its height as well
    assert errors(track_of(found), poses).max() < 0.002


def test_a_false_place_and_a_late_start_are_found_from_the_frames_beside_them():
    frames, poses = slide(1)
    found = followed(frames, start(["box"], [SIZE], poses[0]))
    seen = found.forward.seen
    seen[BEGINS + 1].poses[:], seen[BEGINS + 1].states[:] = seen[BEGINS].poses, [STILL]  # held for a frame
    seen[7].poses[0, :3, 3] += [0.012, 0.0, 0.0]
    assert errors(track_of(found), poses)[[BEGINS + 1, 7], 0].min() > 0.006
    cost = found.cost()
    Smoother(found, frames).smooth()
    track = track_of(found)
    assert errors(track, poses).max() < 0.002
    assert track.states[BEGINS + 1] == [MOVING] and track.states[BEGINS - 1] == [STILL]
    assert found.cost() < cost


def test_what_rests_has_one_pose_nearer_to_the_truth_than_that_of_a_frame():
    wandering = []
    for seed in range(4):
        frames, poses = slide(seed)
        found = followed(frames, start(["box"], [SIZE], poses[0]))
        before = errors(track_of(found), poses)[-1, 0]
        Smoother(found, frames).smooth()
        track = track_of(found)
        resting = np.array([track.poses[t, 0] for t in range(FRAMES) if t > ENDS and track.states[t] == [STILL]])
        assert len(resting) and np.ptp(resting, axis=0).max() == 0.0
        wandering.append((before, errors(track, poses)[-1, 0]))
    assert np.mean(wandering, axis=0)[1] < np.mean(wandering, axis=0)[0]


def test_what_rests_is_as_sure_as_in_the_middle_of_its_frames_and_what_moves_as_in_each():
    """As sure as the frame that told most, things before a noisier sensor were off by more in a fifth of the frames."""
    frames, poses = slide(0)
    smoother = Smoother(followed(frames, start(["box"], [SIZE], poses[0])), frames)
    smoother.states[:, 0] = [STILL] * 5 + [MOVING] * (FRAMES - 5)
    wide = [3.0, 1.0, 5.0, 2.0, 4.0, *np.arange(6.0, 6.0 + FRAMES - 5)]
    smoother._spread(0, [Fit(pose, np.eye(6), w * np.eye(6), np.eye(3), np.zeros(3))
                         for pose, w in zip(poses[:, 0], wide, strict=True)])  # fmt: skip
    found = [recorder.seen[n].covariances[0][0, 0] for _, recorder, n in smoother.rows]
    assert found == [3.0] * 5 + wide[5:]


def test_a_film_costs_what_its_images_cost_as_they_are_drawn_in_the_end():
    """Frames were charged for sizes and places that nothing drew: a pass of a moving camera with a wrong size was
    thousands of nats too cheap, and was kept in place of one that explains all images."""
    frames, poses = slide(0)
    off = np.array([0.008, -0.008, 0.0])
    for moving_camera in (False, True):
        recorder = Recorder(frames[0], CAMERA, start(["box"], [SIZE + off], poses[0]), GRAVITY, 1 / FPS, moving_camera)
        for frame in frames[1:]:
            recorder.advance(frame)
        found = Pass(0, start(["box"], [SIZE + off], poses[0]), recorder, None)
        smoother = Smoother(found, frames)
        smoother.smooth()
        drawn = sum(Smoother(found, frames).before)
        if moving_camera:  # what is beyond its images' cost is that of the camera's motion
            assert drawn < found.cost()
        else:
            assert found.cost() == pytest.approx(drawn, abs=1e-3)


def test_how_high_a_thing_is_that_stands_outlines_of_its_foot_do_not_tell():
    """A foot that sinks into the floor changes no image: only noise that shows a gap told heights, as too small."""
    frames, poses = slide(2)
    found = followed(frames, start(["box"], [SIZE], poses[0]))
    smoother = Smoother(found, frames)
    smoother._place(6)
    assert smoother._fit(6, 0, True).told[2].tolist() == [0.0, 0.0, 0.0]
    smoother.poses[6, 0, :3, 3] += 0.02 * films.view()[:3, 2]  # in the air its foot is an outline like others
    assert smoother._fit(6, 0, True).told[2, 2] > 0.0


def test_a_frame_that_seems_to_tell_a_hundred_times_what_others_do_does_not_keep_a_wrong_size():
    """An outline that falls along a row of pixels does: a box stayed 2 mm too long of the 4 that others took off."""
    frames, poses = slide(3)
    smoother = Smoother(followed(frames, start(["box"], [SIZE], poses[0])), frames)
    thing = smoother.tracker.things[0]
    smoother.known[0].size, thing.size = SIZE + [0.004, 0, 0], SIZE + [0.004, 0, 0]
    smoother.known[0].covariance[6, 6] = 0.004**2
    moving = [t for t, state in enumerate(smoother.states[:, 0]) if state == MOVING]
    fits = [None] * FRAMES
    for t in moving:
        told = np.diag([1e6, 0.0, 0.0]) if t != moving[1] else np.diag([200e6, 0.0, 0.0])  # 1 mm, or a tenth of it
        grown = told[0] * (-0.004 if t != moving[1] else 0.0)
        fits[t] = Fit(smoother.poses[t, 0], np.eye(6), np.eye(6), told, grown)
    smoother._grow(0, fits)
    assert len(moving) > 5 and 0.0 < thing.size[0] - SIZE[0] < 0.002


def test_a_size_is_as_sure_as_what_tells_it():
    """It was as sure as the filter had it, which counts what outlines are off by alike anew in each frame."""
    frames, poses = slide(3)
    smoother = Smoother(followed(frames, start(["box"], [SIZE], poses[0])), frames)
    known, thing = smoother.known[0], smoother.tracker.things[0]
    known.covariance[6:, 6:] = np.diag([0.02, 0.02, 0.001]) ** 2
    thing.size, thing.covariance[6:, 6:] = known.size.copy(), 1e-8 * np.eye(3)
    fit = Fit(poses[0, 0], np.eye(6), np.eye(6), np.diag([1e12, 0.0, 0.0]), np.zeros(3))
    smoother._grow(0, [fit if state == MOVING else None for state in smoother.states[:, 0]])
    least = smoother.tracker.bias(thing)  # by which outlines are off in all frames alike
    deviations = np.sqrt(np.diag(thing.covariance)[6:])
    assert least < deviations[0] < 2 * least and np.allclose(deviations[1:], [0.02, 0.001])
