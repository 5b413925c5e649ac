"""Films are read in counting order; what is wrong with one is a line, and never a crash."""

import io
import json
from types import SimpleNamespace

import numpy as np
import pytest

from derender.errors import DerenderError
from derender.scene.pose import from_rotation_vector
from derender.structures.options import Options
from derender.tracking import run
from derender.tracking.film import GRAVITY_SPREAD, LEVEL_SPREAD, counted, frame_files, level_spread, read_film
from derender.tracking.run import patiently

CAMERA = {"fx": 80, "fy": 80, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48}


def write(folder, count=3, shape=(48, 64), **told):
    folder.mkdir(exist_ok=True)
    for t in range(count):
        np.save(folder / f"frame_{t}.npy", np.full(shape, 0.5 + 0.01 * t, np.float32))
    (folder / "camera.json").write_text(json.dumps({**CAMERA, **told}))
    return folder


def test_a_folder_is_read_in_counting_order_with_the_camera_beside_it(tmp_path):
    film = read_film([write(tmp_path / "f", 12, fps=24, gravity=[0, 9.0, 3.9])])
    assert [name for name in film.names[-3:]] == ["frame_9.npy", "frame_10.npy", "frame_11.npy"]
    assert film.times[1] == pytest.approx(1 / 24) and not film.fps_is_guess and not film.camera_is_guess
    assert np.allclose(film.gravity, [0, 9.0, 3.9]) and film.camera.fx == 80
    assert frame_files([str(tmp_path / "f" / "frame_1*.npy")])[0].name == "frame_1.npy"


def test_fps_of_the_command_goes_before_that_of_the_camera(tmp_path):
    film = read_film([write(tmp_path / "f", fps=24)], fps=50)
    assert film.times[1] == pytest.approx(0.02)
    (told,) = (note for note in film.notes if "frames a second" in note)
    assert "the camera says 24 frames" in told and "--fps 50" in told
    assert not any("frames a second" in note for note in read_film([tmp_path / "f"], fps=24).notes)


def test_one_file_holds_a_whole_film(tmp_path):
    depth = np.full((5, 48, 64), 0.7, np.float32)
    np.savez(tmp_path / "film.npz", depth=depth, fps=10.0, K=[[80, 0, 31.5], [0, 80, 23.5], [0, 0, 1]])
    film = read_film([tmp_path / "film.npz"])
    assert len(film.frames) == 5 and film.times[-1] == pytest.approx(0.4) and film.camera.fx == 80


METRES = np.linspace(0.6, 0.9, 5 * 48 * 64, dtype=np.float32).reshape(5, 48, 64)
FORMS = {
    "half millimetres": ({"depth": (1000 * METRES).astype(np.float16)}, 1.0),
    "whole millimetres": ({"depth": (1000 * METRES).astype(np.uint16)}, None),
    "ten to a millimetre": ({"depth": (10000 * METRES).astype(np.uint16)}, 0.1),
    "a channel": ({"depth": METRES[..., None]}, None),
    "a channel first": ({"depth": METRES[:, None]}, None),
    "another name": ({"depths": METRES, "rgb": np.zeros((5, 48, 64, 3), np.uint8)}, None),
    "no name": ({"arr_0": METRES}, None),
    "a matrix for each": ({"frames": METRES, "K": np.tile([[80, 0, 31.5], [0, 80, 23.5], [0, 0, 1]], (5, 1, 1))}, None),
    "timestamps": ({"depth": METRES, "timestamps": 0.1 * np.arange(5)}, None),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_whole_film_is_read_as_images_are(tmp_path, form):
    arrays, scale = FORMS[form]
    np.savez(tmp_path / "film.npz", **arrays)
    film = read_film([tmp_path / "film.npz"], depth_scale=scale)
    assert np.allclose(film.frames, METRES, atol=1e-3)
    assert film.camera_is_guess == ("K" not in arrays) and film.fps_is_guess == ("timestamps" not in arrays)


def test_an_array_of_images_is_a_film(tmp_path):
    np.save(tmp_path / "film.npy", METRES)
    (tmp_path / "camera.json").write_text(json.dumps({**CAMERA, "fps": 10}))
    film = read_film([tmp_path / "film.npy"])
    assert np.allclose(film.frames, METRES) and film.camera.fx == 80 and film.times[1] == pytest.approx(0.1)


def test_a_whole_film_in_millimetres_without_a_unit_is_a_fault(tmp_path):
    np.savez(tmp_path / "film.npz", depth=1000 * METRES)
    with pytest.raises(DerenderError, match="set --depth-scale"):
        read_film([tmp_path / "film.npz"])


def test_times_of_the_camera_file_are_the_times(tmp_path):
    assert np.allclose(read_film([write(tmp_path / "f", times=[0, 0.1, 0.3])]).times, [0, 0.1, 0.3])


def test_a_frame_that_the_sensor_dropped_is_one_without_depth_in_a_folder_as_in_one_file(tmp_path):
    folder = write(tmp_path / "f")
    np.save(folder / "frame_1.npy", np.zeros((48, 64), np.float32))
    np.savez(tmp_path / "film.npz", depth=[np.load(folder / f"frame_{t}.npy") for t in range(3)])
    for source in (folder, tmp_path / "film.npz"):
        assert [bool(np.isfinite(frame).any()) for frame in read_film([source]).frames] == [True, False, True]


def test_frames_that_numbers_or_times_show_to_be_missing_are_put_in_without_depth(tmp_path):
    """A folder without frames 5, 11 and 12 was taken for a faster film: friction .24 for .17, 8 deviations off."""
    folder = write(tmp_path / "f", 9, fps=10)
    for t in (3, 5, 6):
        (folder / f"frame_{t}.npy").unlink()
    film = read_film([folder])
    assert np.allclose(film.times, 0.1 * np.arange(9)) and [n for n in range(9) if film.names[n] == "missing"] == [
        3,
        5,
        6,
    ]
    assert [bool(np.isfinite(frame).any()) for frame in film.frames] == [n not in (3, 5, 6) for n in range(9)]
    assert "3 frames are missing" in film.notes[0] and "frame_4.npy, frame_7.npy" in film.notes[0]
    timed = read_film([write(tmp_path / "g", 6, times=[0, 0.1, 0.2, 0.41, 0.5, 0.6])])
    assert np.allclose(timed.times, [0, 0.1, 0.2, 0.305, 0.41, 0.5, 0.6]) and timed.names[3] == "missing"


def test_a_film_begins_with_the_first_frame_that_shows_something_and_time_with_the_first(tmp_path):
    """Sensors' first frames are often dark: such a film was refused."""
    folder = write(tmp_path / "f", 5, fps=10)
    for t in (0, 1):
        np.save(folder / f"frame_{t}.npy", np.where(np.arange(64) < 10 * t, 0.9, np.zeros((48, 64), np.float32)))
    film = read_film([folder])
    assert film.names == ["frame_2.npy", "frame_3.npy", "frame_4.npy"] and np.allclose(film.times, [0.2, 0.3, 0.4])
    assert len(film.frames) == 3 and "first 2 frames" in film.notes[0] and "frame_2.npy" in film.notes[0]


def test_a_film_that_is_watched_may_begin_dark_and_lack_frames(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "PATIENCE", 0.1)
    folder, told = write(tmp_path / "f", 8, fps=10), []
    np.save(folder / "frame_0.npy", np.zeros((48, 64), np.float32))
    for t in range(1, 8):
        np.save(folder / f"frame_{t}.npy", np.full((48, 64), 0.9, np.float32))
    (folder / "frame_5.npy").unlink()
    found = run.track_to_folder([folder], Options(seed=1), tmp_path / "out", watch=True, warn=told.append).track
    assert found.frames == [f"frame_{t}.npy" if t != 5 else "missing" for t in range(1, 8)]
    assert np.allclose(found.times, 0.1 * np.arange(1, 8)) and found.rate_spread == 0
    assert "beginning with frame_1.npy" in told[0] and "1 frames are missing" in told[-1]
    # what the first image leaves in doubt
    assert "where the film begins, nothing is seen but one surface" in found.doubts[0]
    for path in folder.glob("frame*"):
        np.save(path, np.zeros((48, 64), np.float32))
    with pytest.raises(DerenderError, match="no frame has a pixel"):
        run.track_to_folder([folder], Options(seed=1), tmp_path / "out", watch=True)


def test_a_frame_that_cannot_be_read_is_told_and_without_depth(tmp_path, monkeypatch):
    """One frame that was cut off while it was written ended the whole film."""
    folder, told = write(tmp_path / "f", 9), []
    for t in (4, 5):
        (folder / f"frame_{t}.npy").write_bytes((folder / "frame_3.npy").read_bytes()[:1000])
    film = read_film([folder])
    assert [bool(np.isfinite(frame).any()) for frame in film.frames] == [n not in (4, 5) for n in range(9)]
    assert len(film.notes) == 1 and film.notes[0].startswith(
        "frame_4.npy, frame_5.npy cannot be read (the .npy file is"
    )
    monkeypatch.setattr(run, "PATIENCE", 0.1)
    monkeypatch.setattr(run, "STALLED", 0.1)
    came = [bool(np.isfinite(seen.depth).any()) for _, seen in run.watched([folder], None, None, told.append)]
    assert came == [n not in (4, 5) for n in range(9)] and len(told) == 2 and "frame_5.npy cannot be read" in told[1]
    np.save(folder / "frame_6.npy", np.ones((24, 32), np.float32))
    with pytest.raises(DerenderError, match="3 of 9 frames cannot be read"):
        read_film([folder])
    (folder / "frame_0.npy").write_bytes(b"")
    with pytest.raises(DerenderError, match="frame_0.npy: the file is empty"):
        read_film([folder])


def test_a_floor_that_nearly_agrees_with_gravity_may_be_level():
    """Gravity that was 3 degrees off told a friction of .226 to .244 where .283 was true."""

    def spread(degrees, known=True, floor=True):
        plane = from_rotation_vector([0.4, 0.2, 0.1])
        down = from_rotation_vector(np.radians(degrees) * plane[:3, 0])[:3, :3] @ -plane[:3, 2]
        return level_spread(plane if floor else None, 9.81 * down, known)

    np.testing.assert_allclose([spread(d) for d in (0, 0.2, 3)], np.sin(np.radians([0, 0.2, 3])), atol=1e-12)
    assert spread(8) == spread(20) == spread(3, floor=False) == GRAVITY_SPREAD
    assert spread(3, known=False) == LEVEL_SPREAD


@pytest.mark.parametrize(
    "names",
    [("a", "b", "c"), ("f_12", "f_40", "f_41"), ("f_1", "f_2", "f_4_x2"), ("f_3", "f_2", "f_1"), ("f", "f", "f")],
)
def test_names_that_count_no_frames_are_taken_one_by_one(names):
    assert counted(names).tolist() == [0, 1, 2]


def test_names_count_in_steps_of_the_usual_one():
    assert counted(["c1_d005", "c1_d010", "c1_d015", "c1_d025"]).tolist() == [0, 1, 2, 4]
    assert counted([f"1305031453.{part}.png" for part in (35, 38, 41, 47)]).tolist() == [0, 1, 2, 4]


def test_a_frame_that_was_written_twice_was_not_taken_anew(tmp_path):
    rng = np.random.default_rng(0)
    noisy = 0.7 + 0.001 * rng.standard_normal((6, 48, 64))
    noisy[3] = noisy[2]
    np.save(tmp_path / "film.npy", noisy)
    film = read_film([tmp_path / "film.npy"])
    assert [bool(np.isfinite(frame).any()) for frame in film.frames] == [True, True, True, False, True, True]
    assert "film[3] repeat" in film.notes[0]
    still = np.full((6, 48, 64), 0.7)
    still[2:, 10:20, 10:20] -= 0.1  # a rendering without noise in which one thing jumps
    np.save(tmp_path / "film.npy", still)
    assert np.isfinite(read_film([tmp_path / "film.npy"]).frames).all()


def test_times_and_gravity_in_other_units_are_said(tmp_path):
    """Times in nanoseconds ended in a traceback of the engine, and in milliseconds its films took for ever."""
    film = read_film([write(tmp_path / "f", times=[0, 33, 67], gravity=[0, 0.9, 0.43])])
    assert "33.5 s apart" in film.notes[0] and "in g" in film.notes[1]
    assert not read_film([write(tmp_path / "g", times=[0, 0.1, 0.2], gravity=[0, 9.0, 3.9])]).notes


FAULTS = {
    "empty": (lambda folder: [p.unlink() for p in folder.glob("frame*")], "the film is empty"),
    "sizes": (lambda folder: np.save(folder / "frame_1.npy", np.ones((24, 32), np.float32)), "pixels"),
    "backwards": (lambda folder: write(folder, times=[0, 0.2, 0.1]), "time runs backwards"),
    "still": (lambda folder: write(folder, times=[0, 0, 0.1]), "time runs backwards"),
    "fps": (lambda folder: write(folder, fps=-30), "fps is -30"),
    "gravity": (lambda folder: write(folder, gravity=[0, 0]), "gravity"),
    "not finite": (lambda folder: write(folder, gravity=[0, float("nan"), 9.8]), "gravity"),
    "times": (lambda folder: write(folder, times=[0, 0.1]), "3 frames and 2 times"),
    "nothing": (
        lambda folder: [np.save(p, np.zeros((48, 64), np.float32)) for p in folder.glob("frame*")],
        "no frame has",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_one_line(tmp_path, name):
    folder = write(tmp_path / "f")
    spoil, words = FAULTS[name]
    spoil(folder)
    with pytest.raises(DerenderError) as caught:
        read_film([folder])
    assert words in str(caught.value) and "\n" not in str(caught.value)


def test_a_name_that_is_not_there_is_said(tmp_path):
    with pytest.raises(DerenderError):
        read_film([tmp_path / "none"])


def test_a_frame_that_is_still_being_copied_is_waited_for(tmp_path, monkeypatch):
    whole = io.BytesIO()
    np.save(whole, np.ones((4, 4), np.float32))
    path, pieces = tmp_path / "a.npy", [whole.getvalue()[:count] for count in (40, 100, 140)] + [whole.getvalue()]
    clock = [0.0]

    def sleep(seconds):
        clock[0] += 1.5  # each piece comes so much later
        if pieces:
            path.write_bytes(pieces.pop(0))

    monkeypatch.setattr("derender.tracking.run.time", SimpleNamespace(monotonic=lambda: clock[0], sleep=sleep))
    assert patiently(path, None, None).depth.shape == (4, 4)
    path.write_bytes(b"half")
    with pytest.raises(DerenderError):
        patiently(path, None, None)
