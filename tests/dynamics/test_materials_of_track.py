"""What `infer --track --dynamics` writes, from a track that is made up."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from derender.dynamics.parameters import Parameters, read_dynamics_prior
from derender.dynamics.result import Answer
from derender.errors import DerenderError
from derender.scene.pose import from_rotation_vector, inverse, rotation_vector
from derender.tracking import materials
from derender.tracking.materials import materials_to_folder, motion_of_track, rests_ahead
from derender.tracking.path import BAND, changed, errors_of
from derender.tracking.track import Track

FRAMES, STEP = 14, 1 / 30


def track(positions, view=None, parent=1):
    """Return the track of one upright box by a camera that looks along the floor's normal, at views (4, 4)."""
    floor = np.diag([1.0, -1.0, -1.0, 1.0])
    floor[2, 3] = 1.0
    poses = np.tile(floor, (FRAMES, 1, 1, 1)) @ np.eye(4)
    poses[:, 0, :3, 3] = (floor[:3, :3] @ np.asarray(positions, float).T).T + floor[:3, 3]
    views = np.tile(np.eye(4) if view is None else view, (FRAMES, 1, 1))
    chances = np.zeros((FRAMES, 1, 3))
    chances[..., parent] = 1.0
    errors = np.diag([5e-4, 4e-4, 3e-4, 5e-3, 4e-3, 3e-3]) ** 2
    return Track(
        ["box_1"], ["box"], np.array([1]), STEP * np.arange(FRAMES), [str(t) for t in range(FRAMES)],
        np.tile([0.08, 0.07, 0.05], (FRAMES, 1, 1)), views[:, None] @ poses, np.tile(errors, (FRAMES, 1, 1, 1)),
        [["moving"]] * FRAMES, chances, views, np.zeros((BAND, 0)), floor, np.array([0.0, 0.0, 9.81]), np.zeros(FRAMES),
        np.zeros((FRAMES, 1, 4)),
    )  # fmt: skip


def together(one, other, **changes):
    """Return the track of two boxes from those of one each."""
    joined = {
        name: np.concatenate([getattr(one, name), getattr(other, name)], axis=1)
        for name in ("sizes", "poses", "covariances", "pixels")
    }
    chances = np.zeros((FRAMES, 2, 4))
    chances[..., 1] = 1.0
    both = replace(one, names=["box_1", "box_2"], types=["box"] * 2, kinds=np.ones(2, int),
                   states=[["moving"] * 2] * FRAMES, parent_probability=chances, **joined)  # fmt: skip
    return replace(both, **changes)


def sliding(friction=0.3, speed=0.8):
    time = np.minimum(STEP * np.arange(FRAMES), speed / (friction * 9.81))
    x = speed * time - friction * 9.81 * time**2 / 2
    return np.column_stack([x, 0 * x, 0 * x + 0.025])


def test_poses_are_told_in_the_first_cameras_axes_and_errors_in_the_bodys():
    view = from_rotation_vector([0.1, 0.4, -0.2])
    view[:3, 3] = 0.1, 0.2, 0.3
    still, moved = motion_of_track(track(sliding())), motion_of_track(track(sliding(), view))
    np.testing.assert_allclose(moved.poses, still.poses, atol=1e-12)
    turn = inverse(view)[:3, :3]
    np.testing.assert_allclose(moved.covariances[0, 0, :3, :3], turn @ still.covariances[0, 0, :3, :3] @ turn.T)


def test_where_the_camera_is_off_things_are_so_the_other_way_in_all_frames_together():
    rng = np.random.default_rng(0)
    view = from_rotation_vector([0.1, 0.4, -0.2])
    view[:3, 3] = 0.1, 0.2, 0.3
    factor = np.zeros((BAND, 6 * FRAMES))
    factor[0], factor[1:] = 1e4, 1e3 * rng.standard_normal((BAND - 1, 6 * FRAMES))
    known = replace(track(sliding(), view), view_factor=factor)
    numbers = rng.standard_normal(6 * FRAMES)
    off = np.array([changed(*pair) for pair in zip(known.views, errors_of(factor) @ numbers, strict=True)])
    still, moved = motion_of_track(known), motion_of_track(replace(known, views=off))
    change = still.shared[:, 0] @ numbers
    apart = inverse(still.poses[:, 0]) @ moved.poses[:, 0]
    np.testing.assert_allclose((moved.poses - still.poses)[:, 0, :3, 3], change[:, :3], atol=1e-6)
    np.testing.assert_allclose([rotation_vector(each) for each in apart], change[:, 3:], atol=1e-6)
    assert np.abs(change).max() > 1e-4


def test_what_a_bounce_takes_is_said_in_seconds():
    answer = Answer.__new__(Answer)
    answer.unexplained = False
    answer.parameters, answer.told = Parameters(("box",), np.ones(1), read_dynamics_prior()), ["contact_time"]
    answer.labels = answer.parameters.labels
    answer.draws = {name: np.full(9, 0.004) for name in answer.labels}
    answer.draws["velocity.box"] = np.zeros((9, 3))
    assert "contact_time   0.004 (0.004-0.004) s" in answer.lines()


@pytest.mark.parametrize("resting, said", [(1.0, {"box_1"}), (0.5, set())])
def test_what_does_not_come_to_rest_is_not_said_to(monkeypatch, resting, said):
    """What fell or rolled on was said to come to rest where it was after two seconds."""
    ends = np.zeros((60, 1, 13))
    ends[round(60 * resting) :, 0, 7] = 1.0
    monkeypatch.setattr(materials, "predict", lambda *_: ends)
    moving = SimpleNamespace(states=np.full((1, 1, 13), 0.5))
    found = SimpleNamespace(modes=[SimpleNamespace(path=moving)])
    assert set(rests_ahead(found, motion_of_track(track(sliding())), np.random.default_rng(0))) == said


@pytest.mark.slow
def test_a_slide_says_its_friction_in_track_json_and_in_draws(tmp_path):
    (tmp_path / "track.json").write_text(json.dumps({"objects": [], "parameters": {}}))
    (tmp_path / "report.html").write_text("<main></main>")
    lines = materials_to_folder(track(sliding()), tmp_path, 0, "test")
    assert all(line in (tmp_path / "report.html").read_text() for line in lines)
    told = json.loads((tmp_path / "track.json").read_text())["parameters"]
    assert set(told) == {"friction"}
    low, high = told["friction"]["interval"]
    assert low < 0.3 < high and high - low < 0.06
    assert any(line.startswith("restitution") and "does not tell" in line for line in lines)
    with np.load(tmp_path / "dynamics.npz") as file:
        assert file["friction"].shape[0] == 1 and file["velocity.box_1"].shape[::2] == (1, 3)
        assert abs(file["velocity.box_1"].mean(axis=1)[0, 0] - 0.8) < 0.05
        assert json.loads(str(file["header"]))["seed"] == 0


def test_what_a_hand_holds_is_left_out_and_nothing_else_is_an_error():
    lifted = np.column_stack([np.zeros((FRAMES, 2)), 0.05 + 0.3 * STEP * np.arange(FRAMES)])
    with pytest.raises(DerenderError, match="nothing moves by itself"):
        motion_of_track(track(lifted, parent=0))


def test_what_bounces_often_is_in_no_hand():
    time = STEP * np.arange(FRAMES)
    since = np.mod(time, 2.9 * STEP)
    heights = 0.5 * 9.81 * since * (2.9 * STEP - since)
    bouncing = np.column_stack([0.3 * time, 0 * time, 0.025 + heights])
    assert motion_of_track(track(bouncing, parent=0)).names == ("box_1",)


def test_what_falls_is_in_no_hand_however_fast_the_frames_and_however_uncertain_their_poses():
    step, rng = 1 / 60, np.random.default_rng(0)
    heights = 0.5 - 0.5 * 9.81 * (step * np.arange(FRAMES)) ** 2
    falling = track(
        np.column_stack([np.zeros((FRAMES, 2)), heights]) + 1e-3 * rng.standard_normal((FRAMES, 3)), parent=0
    )
    assert motion_of_track(replace(falling, times=step * np.arange(FRAMES))).names == ("box_1",)


def test_what_rested_and_is_pushed_by_nothing_in_sight_is_left_out():
    pushed = sliding()
    pushed = np.concatenate([np.tile(pushed[:1], (4, 1)), pushed[:-4]])
    with pytest.raises(DerenderError, match="nothing moves by itself"):
        motion_of_track(track(pushed))
    assert motion_of_track(track(sliding())).names == ("box_1",)


def test_what_another_thing_has_entered_is_not_where_it_is_told():
    """A half hidden box that was struck was held where it had rested, 30 mm off, and told a friction of .20 to .35."""
    resting, moving = track(np.tile([0.15, 0, 0.025], (FRAMES, 1))), track(sliding())
    film = together(resting, moving, states=[["still", "moving"]] * FRAMES)
    film.pixels[:, :, 1] = [40, 300]
    seen = motion_of_track(film)
    inside = seen.poses[:, -1, 0, 3] > 0.15 - 0.08 + materials.ENTERED
    assert inside[-1] and not inside[0] and np.isfinite(seen.poses[:, -1]).all()
    np.testing.assert_array_equal(np.isfinite(seen.poses[:, 0]).all(axis=(1, 2)), ~inside)


def test_what_rested_and_is_struck_by_what_moves_is_kept():
    mover = np.column_stack([0.9 * STEP * np.minimum(np.arange(FRAMES), 5), np.zeros(FRAMES), np.full(FRAMES, 0.025)])
    struck = mover.copy()
    struck[:, 0] = 0.23 + 0.9 * STEP * np.maximum(np.arange(FRAMES) - 5, 0)

    def both(distance):
        return together(track(mover), track(struck + [distance, 0, 0]))

    assert motion_of_track(both(0.0)).names == ("box_1", "box_2")
    assert motion_of_track(both(0.1)).names == ("box_1",)


@pytest.mark.slow
def test_things_that_never_meet_have_a_friction_each(tmp_path):
    """Told as of one material, frictions of .15 and .45 were not told at all, and of .2 and .3 as .17 to .37."""
    (tmp_path / "track.json").write_text(json.dumps({"objects": []}))
    film = together(track(sliding(0.2, 0.7)), track(sliding(0.4, 1.0) + [0.0, 0.3, 0.0]))
    lines = materials_to_folder(film, tmp_path, 0, "test")
    told = json.loads((tmp_path / "track.json").read_text())["parameters"]
    for name, friction in (("friction.box_1", 0.2), ("friction.box_2", 0.4)):
        low, high = told[name]["interval"]
        assert low < friction < high < 1.2 * low and any(line.startswith(name.replace(".", " ")) for line in lines)
    assert told["friction"] == {"of": told["friction"]["of"], **told[f"friction.{told['friction']['of']}"]}
    with np.load(tmp_path / "dynamics.npz") as file:
        assert {"friction.box_1", "error.impact.box_2", "velocity.box_2"} < set(file.files)


def test_what_comes_near_is_one_motion_and_what_does_not_is_another():
    miss = motion_of_track(together(track(sliding()), track(sliding() + [0.0, 0.09, 0.0])))
    assert [part.names for part in miss.parts()] == [("box_1",), ("box_2",)]
    near = motion_of_track(together(track(sliding()), track(sliding() + [0.0, 0.072, 0.0])))
    assert [part.names for part in near.parts()] == [("box_1", "box_2")]
    alone = miss.parts()[1]
    assert [body.name for body in alone.matter.bodies] == ["floor", "box_2"]
    np.testing.assert_array_equal(alone.poses, miss.poses[:, 1:])


def test_a_film_that_ends_amid_a_slide_says_where_it_will_come_to_rest(tmp_path):
    (tmp_path / "track.json").write_text(json.dumps({"objects": []}))
    film = track(sliding(0.3, 1.8))  # it stops after .55 m, of which the 14 frames show .50 m
    lines = materials_to_folder(film, tmp_path, 0, "test")
    ahead = json.loads((tmp_path / "track.json").read_text())["ahead"]["box_1"]
    low, high = ahead["interval"][0]
    assert low < 1.8**2 / (2 * 0.3 * 9.81) < high and high - low < 0.1
    assert low < ahead["mean"][0] < high and ahead["mean"][2] == pytest.approx(0.975, abs=0.005)
    assert any(line.startswith("box_1 comes to rest at") for line in lines)
