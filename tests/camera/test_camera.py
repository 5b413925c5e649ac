"""Every camera reader on a file as that tool writes it, and every fault in one line."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from derender.camera.camera_file import camera_beside, camera_from_tree, read_camera
from derender.camera.depth_file import Reading, read_depth, write_depth
from derender.camera.intrinsics import Camera
from derender.errors import DerenderError

BOP = '{"cx": 325.2611, "cy": 242.04899, "depth_scale": 0.1,'
BOP += ' "fx": 572.4114, "fy": 573.57043, "height": 480, "width": 640}'
BOP_SCENE = """{
  "0": {"cam_K": [572.4114, 0.0, 325.2611, 0.0, 573.57043, 242.04899, 0.0, 0.0, 1.0],
        "depth_scale": 0.1, "view_level": 2},
  "7": {"cam_K": [600.0, 0.0, 320.0, 0.0, 601.0, 240.0, 0.0, 0.0, 1.0], "cam_R_w2c": [1, 0, 0, 0, 1, 0, 0, 0, 1],
        "cam_t_w2c": [0, 0, 500], "depth_scale": 1.0}
}"""
OPEN3D = """{
	"height" : 480,
	"intrinsic_matrix" :
	[
		525.0, 0.0, 0.0,
		0.0, 526.0, 0.0,
		319.5, 239.5, 1.0
	],
	"width" : 640
}"""
OPEN3D_PARAMETERS = (
    '{"class_name": "PinholeCameraParameters", "extrinsic": [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1], "intrinsic": '
    + OPEN3D
    + ', "version_major": 1, "version_minor": 0}'
)
OPEN3D_TRAJECTORY = '{"class_name": "PinholeCameraTrajectory", "parameters": [' + OPEN3D_PARAMETERS + "]}"
# Open3D's recorder of RealSense bags: units of depth to the metre.
OPEN3D_RECORDER = """{"color_format": "RGB8", "depth_format": "Z16", "depth_scale": 4000.0,
  "device_name": "RealSense L515",
  "height": 480, "intrinsic_matrix": [601.5, 0, 0, 0, 601.8, 0, 327.5, 247.5, 1], "width": 640}"""
ROS1 = """header:
  seq: 2
  stamp:
    secs: 1606
    nsecs: 31
  frame_id: "camera_depth_optical_frame"
height: 480
width: 640
distortion_model: "plumb_bob"
D: [0.0, 0.0, 0.0, 0.0, 0.0]
K: [570.34, 0.0, 319.5, 0.0, 570.35, 239.5, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
P: [570.34, 0.0, 319.5, 0.0, 0.0, 570.35, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: False
---
"""
ROS2 = """header:
  stamp: {sec: 1606, nanosec: 31}
  frame_id: camera_depth_optical_frame
height: 480
width: 640
distortion_model: plumb_bob
d:
- 0.0
- 0.0
k:
- 570.34
- 0.0
- 319.5
- 0.0
- 570.35
- 239.5
- 0.0
- 0.0
- 1.0
binning_x: 0
binning_y: 0
---
"""
ROS_CALIBRATION = """image_width: 640
image_height: 480
camera_name: depth
camera_matrix:
  rows: 3
  cols: 3
  data: [570.34, 0, 319.5, 0, 570.35, 239.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0, 0, 0, 0, 0]
"""
REALSENSE = """{"width": 640, "height": 480, "ppx": 310.25, "ppy": 236.5, "fx": 616.36, "fy": 616.2,
 "model": "distortion.brown_conrady", "coeffs": [0.0, 0.0, 0.0, 0.0, 0.0], "depth_scale": 0.0001}"""
SCENE = "derender: 1\ncamera: {fx: 150, fy: 150, cx: 79.5, cy: 59.5, width: 160, height: 120}\nobjects: {}\n"

CASES = {
    "BOP": (BOP, Camera(572.4114, 573.57043, 325.2611, 242.04899, 640, 480, 0.1)),
    "Open3D": (OPEN3D, Camera(525, 526, 319.5, 239.5, 640, 480)),
    "Open3D parameters": (OPEN3D_PARAMETERS, Camera(525, 526, 319.5, 239.5, 640, 480)),
    "Open3D trajectory": (OPEN3D_TRAJECTORY, Camera(525, 526, 319.5, 239.5, 640, 480)),
    "Open3D recorder": (OPEN3D_RECORDER, Camera(601.5, 601.8, 327.5, 247.5, 640, 480, 0.25)),
    "ROS 1": (ROS1, Camera(570.34, 570.35, 319.5, 239.5, 640, 480)),
    "ROS 2": (ROS2, Camera(570.34, 570.35, 319.5, 239.5, 640, 480)),
    "ROS calibration": (ROS_CALIBRATION, Camera(570.34, 570.35, 319.5, 239.5, 640, 480)),
    "RealSense": (REALSENSE, Camera(616.36, 616.2, 310.25, 236.5, 640, 480, 0.1)),
    "derender scene": (SCENE, Camera(150, 150, 79.5, 59.5, 160, 120)),
}


def same(a, b):
    return np.allclose(list(a.to_dict().values()), list(b.to_dict().values()), rtol=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_reads_a_file_as_the_tool_writes_it(name, tmp_path):
    text, expected = CASES[name]
    path = tmp_path / "camera.json"
    path.write_text(text)
    assert same(read_camera(path), expected)


def test_a_bop_scene_camera_is_chosen_by_the_name_of_the_image(tmp_path):
    path = tmp_path / "scene_camera.json"
    path.write_text(BOP_SCENE)
    assert read_camera(path, (480, 640), frame="000007").fx == 600
    assert read_camera(path, (480, 640), frame="000000").depth_scale == 0.1
    with pytest.raises(DerenderError, match="different cameras"):
        read_camera(path, (480, 640))
    with pytest.raises(DerenderError, match="does not say the image's size"):
        read_camera(path, frame="000007")


def test_what_is_written_is_read_back_exactly(tmp_path):
    camera = Camera(572.4114, 573.57043, 1 / 3, 242.04899, 640, 480, 0.1)
    (tmp_path / "camera.json").write_text(json.dumps(camera.to_dict()))
    assert read_camera(tmp_path / "camera.json") == camera


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "empty"),
        ("[1, 2]", "not a camera"),
        ("{}", "not a camera"),
        ("a: [1", "neither JSON nor YAML"),
        ('{"fx": 1}', "not a whole camera; add fy and cx and cy"),
        ('{"focal": 1}', "no camera in the keys focal"),
        (BOP.replace("640", "0"), "width is 0"),
        (BOP.replace("640", "640.5"), "width is 640.5"),
        (BOP.replace("572.4114", "-572"), "fx is -572"),
        (BOP.replace("572.4114", "NaN"), "fx is nan"),
        (BOP.replace("572.4114", '"wide"'), "fx is 'wide'"),
        (BOP.replace("640", "1e9"), "too large"),
        (REALSENSE.replace("[0.0, 0.0", "[0.1, 0.0"), "rectify first"),
        (ROS1.replace("D: [0.0", "D: [0.2"), "rectify first"),
        (ROS_CALIBRATION.replace("[0, 0, 0, 0, 0]", "[0, 0, 0.01, 0, 0]"), "rectify first"),
        (ROS1.replace("binning_x: 0", "binning_x: 2"), "binning"),
        (ROS1.replace("x_offset: 0", "x_offset: 8"), "region of interest"),
        (OPEN3D.replace("0.0, 526.0, 0.0", "0.0, 526.0"), "8 numbers"),
        ('{"width": 4, "height": 4, "intrinsic_matrix": [5, 0, 2, 0, 5, 2, 0, 1, 1]}', "column-major"),
        ('{"width": 4, "height": 4, "K": [5, 0, 2, 0, 5, 2, 0, 0, 1e-320]}', "fx is inf"),
        ("camera: " * 50, "neither JSON nor YAML"),
    ],
)
def test_a_fault_is_one_clear_line(text, message, tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(DerenderError, match=message) as caught:
        read_camera(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DerenderError, match=r"nowhere.json: cannot read the camera: No such file"):
        read_camera(tmp_path / "nowhere.json")


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_mutated_file_never_gives_a_traceback(data, tmp_path):
    text = data.draw(st.sampled_from([case[0] for case in CASES.values()] + [BOP_SCENE])).encode()
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text)))
        end = data.draw(st.integers(at, min(len(text), at + 20)))
        text = (
            text[:at] + data.draw(st.binary(max_size=8) | st.sampled_from([b"-1", b"1e999", b"[]", b"{}"])) + text[end:]
        )
    path = tmp_path / "camera.json"
    path.write_bytes(text)
    try:
        camera = read_camera(path, (480, 640))
    except DerenderError as error:
        assert "\n" not in str(error)
    else:
        assert camera.fx > 0 and camera.width >= 1


def test_rays_and_points_and_projection_agree():
    camera = Camera(100, 110, 30.5, 20.25, 64, 48)
    rays = camera.rays()
    assert rays[20, 30] == pytest.approx([-0.5 / 100, -0.25 / 110, 1])
    points = camera.points(np.full(camera.shape, 2.0))
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    assert np.allclose(camera.project(points), np.stack([columns, rows], -1), atol=1e-9)
    corners = camera.matrix @ points[5, 7]
    assert corners[:2] / corners[2] == pytest.approx([7, 5])


def test_a_block_of_pixels_has_its_ray_at_their_middle():
    camera = Camera(100, 110, 30.5, 20.25, 64, 48)
    small = camera.downscaled(4)
    middle = camera.rays().reshape(12, 4, 16, 4, 3).mean(axis=(1, 3))
    assert np.allclose(small.rays(), middle, atol=1e-12)


def test_the_camera_of_a_larger_image_is_told_at_the_size_of_this_one(tmp_path):
    """As of a phone, whose intrinsics are those of its colour image: what the message says is the camera."""
    large = Camera(150, 150, 95.5, 71.5, 192, 144)
    write_depth(tmp_path / "small.npy", np.full((24, 32), 0.8), large)
    with pytest.raises(DerenderError, match="32 x 24 pixels, its camera 192 x 144") as caught:
        read_depth(tmp_path / "small.npy", large)
    told = camera_from_tree(json.loads(str(caught.value)[str(caught.value).index("{") :]))
    assert told == large.downscaled(6)
    with pytest.raises(DerenderError) as caught:  # another aspect: not the same camera
        read_depth(tmp_path / "small.npy", Camera(150, 150, 95.5, 71.5, 192, 108))
    assert "{" not in str(caught.value)


def test_a_camera_beside_the_image_is_its_own_unless_one_is_given(tmp_path):
    image = tmp_path / "frame.npy"
    np.save(image, np.ones((48, 64), np.float32))
    assert read_depth(image).camera_is_guess
    (tmp_path / "camera.json").write_text('{"fx": 70, "fy": 71, "cx": 31, "cy": 23}')
    beside = read_depth(image)
    assert not beside.camera_is_guess and (beside.camera.fx, beside.camera.shape) == (70.0, (48, 64))
    assert read_depth(image, {"fx": 90, "fy": 90, "cx": 31, "cy": 23}).camera.fx == 90.0
    (tmp_path / "frame_camera.json").write_text('{"fx": 75, "fy": 75, "cx": 31, "cy": 23}')
    assert read_depth(image).camera.fx == 75.0 and camera_beside(tmp_path).name == "camera.json"
    write_depth(tmp_path / "own.npz", beside.depth, Camera(80, 80, 31, 23, 64, 48))
    assert read_depth(tmp_path / "own.npz").camera.fx == 80.0  # that of the file itself comes first


def test_a_prior_s_camera_comes_with_its_unit(tmp_path):
    camera = Camera(60, 60, 31.5, 23.5, 64, 48, depth_scale=0.1)
    write_depth(tmp_path / "image.png", np.full((48, 64), 0.9), camera)
    assert np.allclose(Reading().read(tmp_path / "image.png", camera).depth, 0.9)
    assert np.allclose(Reading().read(tmp_path / "image.png").depth, 9.0)  # nothing says so
    other = Camera(60, 60, 31.5, 23.5, 32, 24, depth_scale=0.1)
    assert Reading().read(tmp_path / "image.png", other).camera_is_guess  # of another image


def test_the_fallback_sees_sixty_degrees():
    camera = Camera.from_field_of_view(160, 120)
    assert camera.field_of_view == pytest.approx(60)
    left, right = camera.rays()[0, 0, 0] - 0.5 / camera.fx, camera.rays()[0, -1, 0] + 0.5 / camera.fx
    assert np.degrees(np.arctan(right) - np.arctan(left)) == pytest.approx(60)


def test_a_tree_that_holds_itself_ends():
    tree: dict = {}
    tree["camera"] = tree
    with pytest.raises(DerenderError, match="no camera in the keys camera"):
        camera_from_tree(tree)
