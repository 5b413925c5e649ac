"""Bags as input: written here by the library that reads them, as ROS, ROS 2 and the RealSense viewer write them."""

import json
import subprocess
import sys

import numpy as np
import pytest

from derender.batch.frames import find_frames, is_many
from derender.camera.depth_file import read_depth
from derender.camera.image_files import encode_png
from derender.errors import DerenderError

pytest.importorskip("rosbags")

HEIGHT, WIDTH = 6, 8
DEPTHS = [np.linspace(700 + 10 * k, 900, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH).astype(np.uint16) for k in range(3)]
MATRIX = [70.0, 0.0, 3.5, 0.0, 71.0, 2.5, 0.0, 0.0, 1.0]


def write_bag(path, topics, two=False, behind=b""):
    """Write a bag of (topic, message type, [fields of each message]); messages get a header where they have one.

    behind : bytes that are left behind the end of each image.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE if two else Stores.ROS1_NOETIC)
    encode = store.serialize_cdr if two else store.serialize_ros1
    stamp = store.types["builtin_interfaces/msg/Time"](0, 0)
    sequence = {} if two else {"seq": 0}
    header = store.types["std_msgs/msg/Header"](**sequence, stamp=stamp, frame_id="camera")
    with Writer2(path, version=9) if two else Writer1(path) as writer:
        for topic, kind, messages in topics:
            connection = writer.add_connection(topic, kind, typestore=store)
            for number, fields in enumerate(messages):
                given = fields if kind.startswith("std_msgs") else {"header": header, **fields}
                data = bytes(encode(store.types[kind](**given), kind)) + (behind if kind == IMAGE else b"")
                writer.write(connection, 1_000_000 * (number // 2 + 1), data)
    return path


def image(depth, encoding="16UC1", pad=0, big=False):
    """Return the fields of a sensor_msgs/Image, its rows `pad` bytes longer than they need to be."""
    depth = depth.astype(depth.dtype.newbyteorder(">" if big else "<"))
    rows = np.pad(depth.view(np.uint8).reshape(len(depth), -1), ((0, 0), (0, pad)))
    return {"height": len(depth), "width": depth.shape[1], "encoding": encoding, "is_bigendian": int(big),
            "step": rows.shape[1], "data": rows.ravel()}  # fmt: skip


def info(two=False, distortion=(), projection=None):
    """Return the fields of a sensor_msgs/CameraInfo."""
    from rosbags.typesys import Stores, get_typestore

    region = get_typestore(Stores.ROS2_HUMBLE).types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    projection = np.zeros((3, 4)) if projection is None else projection
    arrays = {"D": np.array(distortion, float), "K": np.array(MATRIX), "R": np.eye(3).ravel(), "P": projection.ravel()}
    named = {key.lower() if two else key: value for key, value in arrays.items()}
    return {"height": HEIGHT, "width": WIDTH, "distortion_model": "plumb_bob", **named, "binning_x": 0, "binning_y": 0,
            "roi": region}  # fmt: skip


IMAGE, INFO = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"


@pytest.fixture(params=["bag", "db3"])
def realsense(tmp_path, request):
    """A recording as librealsense 2.55 (.bag) and 2.59 (.db3) make it: a quarter of a millimetre for one unit.

    Topics, types and what stands behind an image's end are those that pyrealsense2's recorder wrote.
    """
    sensor = "/device_0/sensor_0"
    if request.param == "db3":
        pictures = [np.frombuffer(b"\0" * 12 + encode_png(1e-3 * depth, 1.0, "x"), np.uint8) for depth in DEPTHS]
        folder = write_bag(tmp_path / "written", [
            (f"{sensor}/Depth_0/image/data/compressedDepth", "sensor_msgs/msg/CompressedImage",
             [{"format": "16UC1; compressedDepth png", "data": picture} for picture in pictures]),
            ("/device_0/sensor_1/Color_0/image/camera_info", INFO, [info(True, [0.1, 0, 0, 0, 0])]),
            (f"{sensor}/Depth_0/image/camera_info", INFO, [info(True, [0.0] * 5)] * 3),
            (f"{sensor}/option/Depth_Units/value", "std_msgs/msg/String", [{"data": "0.000250"}]),
        ], two=True)  # fmt: skip
        return next(folder.glob("*.db3")).rename(tmp_path / "recording.db3")
    return write_bag(tmp_path / "recording.bag", [
        (f"{sensor}/Depth_0/image/data", IMAGE, [image(depth, "mono16", 4) for depth in DEPTHS]),
        ("/device_0/sensor_1/Color_0/info/camera_info", INFO, [info(distortion=[0.1, 0, 0, 0, 0])]),
        (f"{sensor}/Depth_0/info/camera_info", INFO, [info(distortion=[0.0] * 5)]),
        (f"{sensor}/option/Depth_Units/value", "std_msgs/msg/Float32", [{"data": 0.00025}]),
    ], behind=b"o\x12\x839")  # fmt: skip


def test_a_realsense_bag_has_frames_unit_and_camera(realsense):
    assert is_many([str(realsense)]) and not is_many([f"{realsense}@1"])
    frames = find_frames([str(realsense)], "out")
    assert [frame.name for frame in frames] == ["recording/0", "recording/1", "recording/2"]
    for depth, frame in zip(DEPTHS, frames, strict=True):
        seen = read_depth(frame.path)
        assert np.allclose(seen.depth, 0.00025 * depth) and not seen.camera_is_guess
    assert (seen.camera.fx, seen.camera.fy, seen.camera.cx, seen.camera.cy) == (70.0, 71.0, 3.5, 2.5)
    with pytest.raises(DerenderError, match=r"there are 3 depth images .* count from 0|count from 0"):
        read_depth(f"{realsense}@3")
    with pytest.raises(DerenderError, match="this is a bag of many frames"):
        read_depth(realsense)


def test_ros_2_topics_are_chosen_and_rectified_ones_take_the_projection(tmp_path):
    projection = np.zeros((3, 4))
    projection[:, :3] = np.reshape(MATRIX, (3, 3)) + np.diag([5.0, 5.0, 0.0])
    metres = [1e-3 * depth.astype(np.float32) for depth in DEPTHS]
    png = np.frombuffer(b"\0" * 12 + encode_png(metres[0], 1.0, "x"), np.uint8)
    bag = write_bag(tmp_path / "ros2", [
        ("/a/image_rect", IMAGE, [image(metres[0], "32FC1", big=True)]),
        ("/a/camera_info", INFO, [info(True, [0.1, 0, 0, 0, 0], projection)]),
        ("/b/image_raw", IMAGE, [image(DEPTHS[1])]),
        ("/b/camera_info", INFO, [info(True, [0.1, 0, 0, 0, 0])]),
        ("/c/image_raw/compressedDepth", "sensor_msgs/msg/CompressedImage",
         [{"format": "16UC1; compressedDepth png", "data": png}]),
        ("/d/image", IMAGE, [image(np.zeros((2, 2, 3), np.uint8).reshape(2, 6), "rgb8")]),
    ], two=True)  # fmt: skip
    with pytest.raises(DerenderError, match="3 topics have depth images.*--topic /a/image_rect or /b/image_raw or /c"):
        find_frames([str(bag)], "out")
    seen = read_depth(f"{bag}@0", topic="/a/image_rect")
    assert np.allclose(seen.depth, metres[0]) and seen.camera.fx == 75.0
    with pytest.raises(DerenderError, match="the camera has distortion"):
        read_depth(f"{bag}@0", topic="/b/image_raw")
    assert np.allclose(read_depth(f"{bag}@0", {"fx": 70, "fy": 70, "cx": 3, "cy": 2}, topic="/b/image_raw").depth,
                       1e-3 * DEPTHS[1])  # fmt: skip
    packed = read_depth(f"{bag}@0", {"fx": 70, "fy": 70, "cx": 3, "cy": 2}, topic="/c/image_raw/compressedDepth")
    assert np.allclose(packed.depth, metres[0], atol=6e-4)


def test_only_a_camera_info_of_its_own_namespace_is_an_image_s(tmp_path):
    """Of a recording without the depth camera's own, the colour camera's was taken in silence."""
    colour = ("/camera/color/camera_info", INFO, [info()])
    depth = ("/camera/depth/image_rect_raw", IMAGE, [image(DEPTHS[0])])
    assert read_depth(f"{write_bag(tmp_path / 'one.bag', [colour, depth])}@0").camera_is_guess
    projection = np.pad(np.reshape(MATRIX, (3, 3)) + np.diag([5.0, 5.0, 0.0]), ((0, 0), (0, 1)))
    own = ("/camera/depth/camera_info", INFO, [info(projection=projection)])
    assert read_depth(f"{write_bag(tmp_path / 'two.bag', [colour, depth, own])}@0").camera.fx == 75.0


@pytest.mark.parametrize(
    ("told", "words"),
    [({"binning_x": 2}, "binning_x is 2"), ({"distortion_model": "equidistant"}, "no pinhole camera"),
     ({"roi": (4, 0)}, "region of interest has an offset")],
)  # fmt: skip
def test_a_bag_s_camera_is_refused_as_a_file_s_is(tmp_path, told, words):
    if "roi" in told:
        region = info()["roi"]
        told = {"roi": type(region)(*told["roi"], 0, 0, False)}
    topics = [("/a/image", IMAGE, [image(DEPTHS[0])]), ("/a/camera_info", INFO, [info() | told])]
    bag = write_bag(tmp_path / "x.bag", topics)
    with pytest.raises(DerenderError, match=words):
        read_depth(f"{bag}@0")


def test_compressed_floats_are_unfolded(tmp_path):
    a, b = np.float32(1000.0), np.float32(-3.0)
    units = (a / (1e-3 * DEPTHS[0]) + b).round().astype(np.uint16)
    header = b"\0\0\0\0" + np.array([a, b], "<f4").tobytes()
    data = np.frombuffer(header + encode_png(1e-3 * units, 1.0, "x"), np.uint8)
    compressed = {"format": "32FC1; compressedDepth png", "data": data}
    bag = write_bag(tmp_path / "x.bag", [("/d/compressedDepth", "sensor_msgs/msg/CompressedImage", [compressed])])
    assert np.allclose(read_depth(f"{bag}@0").depth, 1e-3 * DEPTHS[0], atol=1e-3)


def test_what_is_no_bag_is_told_in_a_line(tmp_path):
    (tmp_path / "no.bag").write_bytes(b"#ROSBAG V2.0\nbroken")
    for path, words in (("no.bag", "damaged or no bag"), ("missing.bag", "No such file")):
        with pytest.raises(DerenderError, match=words):
            find_frames([str(tmp_path / path)], "out")
    empty = write_bag(tmp_path / "empty.bag", [("/d/camera_info", INFO, [info()])])
    with pytest.raises(DerenderError, match="no depth images"):
        find_frames([str(empty)], "out")


@pytest.mark.slow
def test_infer_takes_a_bag_as_many_frames_and_one_of_them(tmp_path):
    flat = write_bag(tmp_path / "flat.bag", [
        ("/depth/image", IMAGE, [image(np.full((48, 64), 900 + k, np.uint16)) for k in range(2)]),
        ("/depth/camera_info", INFO, [{**info(distortion=[0.0] * 5), "height": 48, "width": 64}]),
    ])  # fmt: skip
    command = [sys.executable, "-m", "derender", "infer", str(flat), "--quick", "-j", "1", "-o", str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.splitlines() == ["flat/0\ttrusted", "flat/1\ttrusted"], done.stderr
    summary = json.loads((tmp_path / "out" / "flat" / "1" / "summary.json").read_text())
    assert summary["command"] == f"derender infer {flat}@1 --quick"
