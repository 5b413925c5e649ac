"""An image enlarged by repeating pixels is told from one that was not, and taken back to the one it was made of."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

import derender
from derender.camera.intrinsics import Camera
from derender.cli.infer import command
from derender.detection.resampled import enlargement_of
from derender.structures.options import Options
from derender.tracking.run import track_to_folder

CAMERA = Camera(fx=140.0, fy=150.0, cx=81.5, cy=58.0, width=160, height=120)


def enlarged(depth, ratio, centred):
    """Return a depth image enlarged by the nearest pixel, where rows are counted from their middles or their starts."""
    shape = [round(ratio * side) for side in depth.shape]
    rows, columns = (
        np.minimum((np.arange(n) + 0.5 * centred) / ratio, side - 1).astype(int)
        for n, side in zip(shape, depth.shape, strict=True)
    )
    return depth[rows[:, None], columns]


def slope(rng, noise=0.002):
    """Return the depth image (120, 160) of a floor that leans away, with noise."""
    return np.broadcast_to(np.linspace(2.0, 0.6, 120)[:, None], (120, 160)) + noise * rng.standard_normal((120, 160))


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("ratio", [1.25, 1.5, 2, 2.4, 3, 8])
def test_image_enlarged_by_its_nearest_pixels_is_taken_back(ratio, centred):
    rng = np.random.default_rng(5)
    depth = slope(rng)
    depth[rng.random(depth.shape) < 0.05] = np.nan
    large = enlarged(depth, ratio, centred)
    found = enlargement_of(large)
    np.testing.assert_array_equal(found.reduced(large), depth)
    np.testing.assert_array_equal(found.enlarged(depth), large)
    assert found.ratio == pytest.approx(ratio, rel=0.01)


@pytest.mark.parametrize("ratio", [2, 3, 1.5])
def test_camera_of_the_smaller_image_sees_along_the_same_rays(ratio):
    large = enlarged(slope(np.random.default_rng(6)), ratio, centred=True)
    half = 0.5 * (ratio - 1.0)  # from the middle of the first pixel to that of the first one in the smaller image
    camera = Camera(
        fx=ratio * CAMERA.fx, fy=ratio * CAMERA.fy, cx=ratio * CAMERA.cx + half, cy=ratio * CAMERA.cy + half,
        width=large.shape[1], height=large.shape[0],
    )  # fmt: skip
    told = enlargement_of(large).camera(camera)
    # Where steps are no whole numbers of pixels each begins up to half a pixel beside where it would.
    near = 1e-9 if ratio == int(ratio) else 0.5
    assert (told.width, told.height) == (160, 120)
    assert (told.fx, told.fy) == pytest.approx((CAMERA.fx, CAMERA.fy), rel=1e-9 if near < 0.5 else 0.005)
    assert (told.cx, told.cy) == pytest.approx((CAMERA.cx, CAMERA.cy), abs=near)


def test_what_is_seen_may_repeat():
    level = np.full((120, 160), 1.0)
    level[40:60, 30:50] -= 0.04
    level[40:60, 90:130] -= 0.06
    checks = np.kron(np.indices((6, 8)).sum(axis=0) % 2, np.ones((20, 20)))  # fewer rows than are believed
    rounded = np.round(slope(np.random.default_rng(7), 0.0), 2)
    few = slope(np.random.default_rng(8))
    few[20::31] = few[19::31]
    for depth in (level, 1.0 + 0.05 * checks, rounded, few, slope(np.random.default_rng(9))):
        assert enlargement_of(depth) is None


def test_enlarged_image_is_told_as_the_one_it_was_made_of(tmp_path):
    image = derender.sample(seed=3).render(noise=True)
    small, camera = image.depth[::2, ::2], image.camera
    large = np.repeat(np.repeat(small, 2, axis=0), 2, axis=1)
    half = Camera(
        fx=camera.fx / 2, fy=camera.fy / 2, cx=(camera.cx - 0.5) / 2, cy=(camera.cy - 0.5) / 2,
        width=small.shape[1], height=small.shape[0],
    )  # fmt: skip
    told = derender.infer(small, camera=half, quick=True, seed=4)
    with pytest.warns(UserWarning, match=f"taken as the {half.width} x {half.height} that were enlarged"):
        same = derender.infer(large, camera=camera, quick=True, seed=4)
    scenes = [posterior.best.to_yaml() for posterior in (same, told)]
    objects = [text[text.index("root:") : text.index("likelihood:")] for text in scenes]
    assert objects[0] == objects[1]

    np.save(tmp_path / "large.npy", large)
    (tmp_path / "camera.json").write_text(json.dumps(camera.to_dict()))
    arguments = [str(tmp_path / "large.npy"), "--camera", str(tmp_path / "camera.json"), "--quick"]
    ran = CliRunner().invoke(command, [*arguments, "--seed", "4", "-o", str(tmp_path / "out")])
    assert ran.exit_code == 0, ran.output
    assert np.load(tmp_path / "out" / "explained.npy").shape == large.shape
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["camera"]["width"] == camera.width


class Read(Exception):
    """A film that is about to be followed."""


def test_enlarged_film_is_followed_in_the_frames_it_was_made_of(tmp_path, monkeypatch):
    image, rng = derender.sample(seed=3).render(), np.random.default_rng(9)
    camera = image.camera
    small = image.depth[None, ::2, ::2] + 0.001 * rng.standard_normal((3, camera.height // 2, camera.width // 2))
    large = small.repeat(2, axis=1).repeat(2, axis=2)
    np.savez(tmp_path / "large.npz", depth=large, camera=json.dumps(camera.to_dict()), fps=20.0)

    def read(film, *_):
        raise Read(film)

    monkeypatch.setattr("derender.tracking.run.track_film", read)
    said: list[str] = []
    with pytest.raises(Read) as caught:
        track_to_folder([tmp_path / "large.npz"], Options(seed=1), str(tmp_path / "large"), warn=said.append)
    (film,) = caught.value.args
    np.testing.assert_array_equal(film.frames, small)
    assert film.camera == Camera(
        fx=camera.fx / 2, fy=camera.fy / 2, cx=(camera.cx - 0.5) / 2, cy=(camera.cy - 0.5) / 2,
        width=camera.width // 2, height=camera.height // 2,
    )  # fmt: skip
    assert [line for line in said if line.endswith("that were enlarged")]
