"""Camera files as devices and apps write them, turned images, confidence and gravity."""

import json

import numpy as np
import pytest

from derender.camera.camera_file import camera_from_tree, read_camera
from derender.camera.depth_file import DepthImage, Reading, direction, read_depth, turned
from derender.camera.image_files import png_bytes
from derender.camera.intrinsics import Camera
from derender.errors import DerenderError

K = [[1500.0, 0.0, 959.5], [0.0, 1500.0, 719.5], [0.0, 0.0, 1.0]]
FLAT = [1500, 0, 959.5, 0, 1500, 719.5, 0, 0, 1]
BY_COLUMNS = [1500, 0, 0, 0, 1500, 0, 959.5, 719.5, 1]
# A camera that looks level along -z of a world with y upwards: identity in ARKit's axes.
LEVEL = np.eye(4).ravel().tolist()
TILT = 0.5  # radians that it looks down
DOWN = [[1, 0, 0, 0], [0, np.cos(TILT), np.sin(TILT), 0], [0, -np.sin(TILT), np.cos(TILT), 0], [0, 0, 0, 1]]
FALLS = (0.0, np.cos(TILT), np.sin(TILT))  # of a camera that looks down: gravity has a part along its z

DEPTH_CAMERA = (200.0, 200.0, 127.5, 95.5)  # of 256 x 192, the same field of view
FILES = {
    "ARKit, nested": {"intrinsics": K, "imageResolution": [1920, 1440], "transform": LEVEL},
    "ARKit, by rows": {"cameraIntrinsics": FLAT, "imageResolution": {"width": 1920, "height": 1440}},
    "ARKit, by columns": {"intrinsicMatrix": BY_COLUMNS, "w": 1920, "h": 1440},
    "Record3D": {"K": BY_COLUMNS, "w": 1920, "h": 1440, "dw": 256, "dh": 192, "fps": 60, "poses": []},
    "Polycam": {"fx": 1500, "fy": 1500, "cx": 959.5, "cy": 719.5, "width": 1920, "height": 1440,
                **{f"t_{i}{j}": DOWN[i][j] for i in range(3) for j in range(4)}},
    "Nerfstudio": {"fl_x": 1500, "fl_y": 1500, "cx": 960, "cy": 720, "w": 1920, "h": 1440, "k1": 0, "frames": []},
    "OAK": {"boardName": "OAK-D", "cameraData": [
        [0, {"intrinsicMatrix": [[9, 0, 9], [0, 9, 9], [0, 0, 1]], "width": 20, "height": 20}],
        [2, {"intrinsicMatrix": K, "width": 1920, "height": 1440, "distortionCoeff": [0.1, 0.2]}]]},
    "ZED": {"calibration_parameters": {"left_cam": {"fx": 1500, "fy": 1500, "cx": 959.5, "cy": 719.5,
            "disto": [0, 0, 0, 0, 0], "image_size": {"width": 1920, "height": 1440}}}},
}  # fmt: skip


@pytest.mark.parametrize("name", FILES)
def test_a_device_s_camera_is_that_of_its_smaller_depth_image(name, tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps(FILES[name]))
    camera = read_camera(tmp_path / "camera.json", (192, 256))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(DEPTH_CAMERA), camera
    large = read_camera(tmp_path / "camera.json", (1440, 1920))
    assert (large.fx, large.cx, large.cy) == (1500, 959.5, 719.5)
    with pytest.raises(DerenderError, match="1920 x 1440 pixels, the image has 256 x 256"):
        read_camera(tmp_path / "camera.json", (256, 256))


def test_the_same_rays_whatever_the_resolution(tmp_path):
    """The middle of a small pixel is the middle of the 7.5 x 7.5 large ones that it covers."""
    (tmp_path / "camera.json").write_text(json.dumps(FILES["ARKit, nested"]))
    small, large = (read_camera(tmp_path / "camera.json", shape) for shape in ((192, 256), (1440, 1920)))
    for row, column in ((0, 0), (0, 255), (191, 0), (191, 255)):
        place = 7.5 * (np.array([column, row]) + 0.5) - 0.5
        ray = (place - [large.cx, large.cy]) / [large.fx, large.fy]
        np.testing.assert_allclose(small.rays()[row, column, :2], ray, atol=1e-12)


def test_stray_scanner_s_matrix_belongs_to_its_video(tmp_path):
    (tmp_path / "camera_matrix.csv").write_text("1500.0, 0, 959.5\n0, 1500.0, 719.5\n0, 0, 1\n")
    camera = read_camera(tmp_path / "camera_matrix.csv", (192, 256))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(DEPTH_CAMERA)


def test_gravity_stays_in_scene_files_and_images(tmp_path):
    from derender import read_depth, sample
    from derender.camera.depth_file import write_depth
    from derender.document import read_document

    camera = image().camera
    sample("stack", camera=camera).save(tmp_path / "scene.yaml")
    assert read_document(tmp_path / "scene.yaml").camera == camera
    write_depth(tmp_path / "image.npz", 0.01 * image().depth, camera)
    assert read_depth(tmp_path / "image.npz").camera == camera


def test_a_matrix_alone_is_a_camera(tmp_path):
    small = np.array([[200.0, 0, 127.5], [0, 210.0, 95.5], [0, 0, 1]])
    np.save(tmp_path / "k.npy", small)
    np.savetxt(tmp_path / "k.txt", small)
    (tmp_path / "k.json").write_text(json.dumps(small.tolist()))
    for name in ("k.npy", "k.txt", "k.json"):
        camera = read_camera(tmp_path / name, (192, 256))
        assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.shape) == (200, 210, 127.5, 95.5, (192, 256)), name


def test_a_larger_matrix_is_a_camera_where_it_adds_nothing(tmp_path):
    """ScanNet's intrinsic_depth.txt is 4 x 4, ROS' P is 3 x 4."""
    for shape in ((3, 4), (4, 4)):
        whole = np.eye(4)[: shape[0]]
        whole[:3, :3] = [[200.0, 0, 127.5], [0, 210.0, 95.5], [0, 0, 1]]
        np.savetxt(tmp_path / "k.txt", whole)
        np.save(tmp_path / "k.npy", whole)
        for name in ("k.txt", "k.npy"):
            camera = read_camera(tmp_path / name, (192, 256))
            assert (camera.fx, camera.fy, camera.cx, camera.cy) == (200, 210, 127.5, 95.5)
        whole[0, 3] = -30.0
        np.savetxt(tmp_path / "k.txt", whole)
        with pytest.raises(DerenderError, match="no 3 x 3 matrix of intrinsics"):
            read_camera(tmp_path / "k.txt", (192, 256))


def test_a_camera_without_a_size_is_that_of_the_image_only_where_its_middle_is_in_it(tmp_path):
    """A matrix of a colour image twice as large was taken for a depth image's: all sizes were half of what they are."""
    (tmp_path / "k.txt").write_text("900 0 640\n0 900 360\n0 0 1\n")
    with pytest.raises(
        DerenderError, match=r"cx is 640, outside the image \(512 pixels\); .* width and height with it"
    ):
        read_camera(tmp_path / "k.txt", (384, 512))
    said = {"fx": 900, "fy": 900, "cx": 640, "cy": 360, "width": 512, "height": 384}
    (tmp_path / "k.json").write_text(json.dumps(said))
    assert read_camera(tmp_path / "k.json", (384, 512)).cx == 640  # a part of an image


def test_a_camera_of_an_image_twice_as_large_is_refused():
    """README's camera, of 640 x 480 pixels, was taken for an image of 320 x 240, and its two things were trusted."""
    twice = {"fx": 615, "fy": 615, "cx": 320, "cy": 240}
    with pytest.raises(DerenderError, match="the corner of 320 x 240 pixels"):
        camera_from_tree(twice, (240, 320))
    assert camera_from_tree({**twice, "cx": 160}, (240, 320)).cx == 160


def test_distortion_and_raw_calibrations_are_refused(tmp_path):
    for tree, words in (
        (FILES["Nerfstudio"] | {"k1": 0.1}, "distortion"),
        ({**FILES["ZED"]["calibration_parameters"]["left_cam"], "disto": [0.1, 0, 0, 0, 0]}, "distortion"),
        ({"fx": 1, "fy": 1, "cx": 1, "cy": 1, "width": 3, "height": 3, "k1": 0.4}, "distortion"),
        ({"CalibrationInformation": {"Cameras": []}}, "Azure Kinect.*mkv_reader"),
    ):
        (tmp_path / "camera.json").write_text(json.dumps(tree))
        with pytest.raises(DerenderError, match=words):
            read_camera(tmp_path / "camera.json", (192, 256))


def test_a_colour_image_without_pixels_is_refused(tmp_path):
    (tmp_path / "camera.json").write_text(json.dumps(FILES["Record3D"] | {"w": 0}))
    with pytest.raises(DerenderError, match="that of 0 x 1440 pixels"):
        read_camera(tmp_path / "camera.json", (192, 256))


def test_gravity_is_read_from_the_pose(tmp_path):
    trees = {
        "level": (FILES["ARKit, nested"], (0, 1, 0)),
        "rows": ({"intrinsics": K, "transform": DOWN, "w": 1920, "h": 1440}, FALLS),
        "columns": ({"intrinsics": K, "cameraTransform": np.transpose(np.array(DOWN) + MOVED).tolist(),
                     "w": 1920, "h": 1440}, FALLS),
        "Polycam": (FILES["Polycam"], FALLS),
        "said": ({"fx": 9, "fy": 9, "cx": 9, "cy": 9, "gravity": [0, 0, 9.81]}, (0, 0, 1)),
    }  # fmt: skip
    for name, (tree, gravity) in trees.items():
        (tmp_path / "camera.json").write_text(json.dumps(tree))
        assert read_camera(tmp_path / "camera.json", (192, 256)).gravity == pytest.approx(gravity, abs=1e-9), name


MOVED = np.array([[0, 0, 0, 1], [0, 0, 0, 2], [0, 0, 0, 3], [0, 0, 0, 0]])


def image():
    camera = Camera(60, 70, 10, 5, 24, 16, gravity=(0.6, 0.8, 0.0))
    return DepthImage(1.0 + np.arange(24 * 16, dtype=float).reshape(16, 24), camera)


def test_a_turned_camera_sees_the_same_points():
    """Each pixel's point, turned about the optical axis, is what the turned camera sees at the pixel's new place."""
    seen = image()
    now = turned(seen, 90)
    assert now.depth.shape == now.camera.shape == (24, 16)
    assert now.depth[0, -1] == seen.depth[0, 0] and now.depth[0, 0] == seen.depth[-1, 0]  # clockwise
    before, after = seen.camera.points(seen.depth), now.camera.points(now.depth)
    quarter = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(np.rot90(before @ quarter.T, -1), after, atol=1e-9)
    np.testing.assert_allclose(now.camera.gravity, quarter @ seen.camera.gravity)
    whole = turned(turned(seen, 270), 90)
    np.testing.assert_array_equal(whole.depth, seen.depth)
    assert whole.camera == seen.camera


def test_doubtful_pixels_are_dropped(tmp_path):
    np.save(tmp_path / "frame.npy", np.full((4, 5), 0.8, np.float32))
    sure = np.array([[0, 1, 2, 2, 2]] * 4, np.uint8)
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "frame.png").write_bytes(png_bytes(np.repeat(sure[..., None], 3, -1)))
    np.save(tmp_path / "map.npy", sure)
    for place, least, kept in (("maps", 1.0, 16), ("map.npy", 2.0, 12)):
        seen = Reading(confidence=str(tmp_path / place), least_confidence=least).read(tmp_path / "frame.npy")
        assert np.isfinite(seen.depth).sum() == kept
    np.save(tmp_path / "words.npy", np.full((4, 5), "sure"))
    for place, words in (("missing", "cannot read the confidence map"), ("maps", "no pixel has a confidence of 9"),
                         ("words.npy", "no confidence map .it holds <U4")):  # fmt: skip
        with pytest.raises(DerenderError, match=words):
            Reading(confidence=str(tmp_path / place), least_confidence=9).read(tmp_path / "frame.npy")


def test_up_says_where_things_fall(tmp_path):
    np.save(tmp_path / "frame.npy", np.full((4, 5), 0.8, np.float32))
    assert Reading(up="-y").read(tmp_path / "frame.npy").camera.gravity == (0.0, 1.0, 0.0)
    assert Reading(up="0,-3,-4").read(tmp_path / "frame.npy").camera.gravity == pytest.approx((0, 0.6, 0.8))
    assert Reading(up="-x", rotate=90).read(tmp_path / "frame.npy").camera.gravity == pytest.approx((0, 1, 0))
    for wrong in ("w", "1,2", "0,0,0", "nan,0,1"):
        with pytest.raises(DerenderError, match="is no direction; give x,y,z"):
            direction(wrong)


def test_an_npz_may_hold_its_intrinsics_as_numbers(tmp_path):
    """They were not looked at, and 60 degrees were taken: sizes 1.3 times too long."""
    depth = np.full((12, 16), 0.8, np.float32)
    np.savez(tmp_path / "frame.npz", depth=depth, fx=20.0, fy=21, cx=np.float32(7.5), cy=np.ones(2))
    with pytest.raises(DerenderError, match=r"frame\.npz"):
        read_depth(tmp_path / "frame.npz")  # a list is no number
    np.savez(tmp_path / "frame.npz", depth=depth, fx=20.0, fy=21, cx=np.float32(7.5), cy=np.array([5.5]))
    seen = read_depth(tmp_path / "frame.npz")
    assert not seen.camera_is_guess
    assert (seen.camera.fx, seen.camera.fy, seen.camera.cx, seen.camera.cy) == (20.0, 21.0, 7.5, 5.5)
