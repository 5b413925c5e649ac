"""Poses of several images, in every form that people have them, and what is said of those that are none."""

import json

import numpy as np
import pytest

from derender.camera.depth_file import DepthImage, turned
from derender.camera.intrinsics import Camera
from derender.camera.poses import poses_of_camera_file, read_poses, turned_pose, write_poses
from derender.errors import DerenderError
from derender.scene.pose import inverse, random_rotation, translation

NAMES = ("frames/000001.png", "frames/000002.png")
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def poses(count=2, seed=0):
    rng = np.random.default_rng(seed)
    found = np.array([random_rotation(rng) for _ in range(count)])
    found[:, :3, 3] = rng.normal(size=(count, 3))
    return found


def trees():
    """Each form of a file with the two poses."""
    both = poses()
    rows = both.tolist()
    world = [inverse(pose) for pose in both]
    return {
        "list": rows,
        "poses": {"poses": rows},
        "names": dict(zip(("000002", "000001"), rows[::-1], strict=True)),
        "files": dict(zip(("000001.png", "000002.png"), rows, strict=True)),
        "nerfstudio": {"fl_x": 60, "cx": 32, "cy": 24, "frames": [
            {"file_path": f"images/{k + 1}.jpg", "depth_file_path": f"depth/00000{k + 1}.png",
             "transform_matrix": (pose @ OPENGL).tolist()} for k, pose in enumerate(both)]},
        "bop": {str(k + 1): {"cam_K": [60, 0, 32, 0, 60, 24, 0, 0, 1], "cam_R_w2c": pose[:3, :3].ravel().tolist(),
                             "cam_t_w2c": (1000 * pose[:3, 3]).tolist()} for k, pose in enumerate(world)},
    }  # fmt: skip


@pytest.mark.parametrize("form", list(trees()))
def test_every_form_gives_the_same_poses(tmp_path, form):
    path = tmp_path / "poses.json"
    path.write_text(json.dumps(trees()[form]))
    np.testing.assert_allclose(read_poses(path, NAMES), poses(), atol=1e-12)
    found = poses_of_camera_file(str(path), NAMES)
    np.testing.assert_allclose(found, poses(), atol=1e-12)


def test_arrays_and_what_is_written_are_read(tmp_path):
    np.save(tmp_path / "a.npy", poses())
    np.savez(tmp_path / "b.npz", poses=poses())
    np.savez(tmp_path / "c.npz", **{"000001": poses()[0], "000002": poses()[1]})
    write_poses(tmp_path / "d.json", poses())
    for name in ("a.npy", "b.npz", "c.npz", "d.json"):
        np.testing.assert_allclose(read_poses(tmp_path / name, NAMES), poses(), atol=1e-12)


def test_a_camera_without_poses_has_none(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"fx": 60, "fy": 60, "cx": 32, "cy": 24, "width": 64, "height": 48}))
    assert poses_of_camera_file(str(path), NAMES) is None
    assert poses_of_camera_file(None, NAMES) is None


@pytest.mark.parametrize(
    ("tree", "what"),
    [
        (poses(3).tolist(), "3 poses for 2 images"),
        ({"000001": poses()[0].tolist()}, "no pose for frames/000002.png"),
        ([np.eye(4).tolist(), (2.0 * np.eye(4)).tolist()], "is no pose"),
        ([np.eye(4).tolist(), np.diag([2.0, 1.0, 1.0, 1.0]).tolist()], "no rotation"),
        ([np.eye(4).tolist(), np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()], "no rotation"),
        ([np.eye(4).tolist(), poses()[0].T.tolist()], "is no pose"),
        ([np.eye(4).tolist(), translation(0.0, 0.0, 1e308).tolist()], "1e[+]308 m away; poses are in metres"),
        ([np.eye(4).tolist(), np.diag([1e200, 1.0, 1.0, 1.0]).tolist()], "m away; poses are in metres"),
        ({"fx": 60}, "no poses in it"),
        ([[1.0, 2.0], [3.0]], "no poses in it"),
    ],
)
def test_what_is_no_pose_is_told_in_one_line(tmp_path, tree, what):
    path = tmp_path / "poses.json"
    path.write_text(json.dumps(tree))
    with pytest.raises(DerenderError, match=what) as caught:
        read_poses(path, NAMES)
    assert "\n" not in str(caught.value) and "poses.json" in str(caught.value)


def test_a_turned_image_has_a_turned_camera():
    """A point of the world is seen at the same pixel of the turned image by the turned camera."""
    camera, pose = Camera(60, 60, 31.5, 23.5, 64, 48), poses()[0]
    depth = np.zeros((48, 64))
    depth[10, 50] = 1.3
    seen = turned(DepthImage(depth, camera), 90)
    row, column = np.argwhere(seen.depth > 0)[0]
    for image, place, world in (
        (DepthImage(depth, camera), (10, 50), pose),
        (seen, (row, column), turned_pose(pose, 90)),
    ):
        x, y = (place[1] - image.camera.cx) / image.camera.fx, (place[0] - image.camera.cy) / image.camera.fy
        point = world @ [1.3 * x, 1.3 * y, 1.3, 1.0]
        np.testing.assert_allclose(point, pose @ [1.3 * (50 - 31.5) / 60, 1.3 * (10 - 23.5) / 60, 1.3, 1.0], atol=1e-9)
