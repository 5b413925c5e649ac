"""Depth images in a recording of ROS, ROS 2 or the RealSense viewer: a bag's frames and the camera that it holds.

`recording.bag@12` names one frame, the twelfth after the first, of the one topic of depth images or of the one asked
for. Needs the package rosbags (extra `ros`), no ROS.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.camera.image_files import recognise
from derender.errors import DerenderError, optional

SUFFIXES = (".bag", ".db3", ".mcap")
FRAME = re.compile(r"(.+)@(\d+)")
IMAGES, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
UNIT = "Depth_Units/value"  # the topic in which RealSense tells metres for one unit
ENCODINGS = {"16UC1": "u2", "mono16": "u2", "Z16": "u2", "32FC1": "f4"}
COMPRESSED_HEADER = 12  # bytes of compressedDepth before its PNG: a format, and two numbers of a quantisation


class Bag(NamedTuple):
    """What is known of a bag before its frames are read.

    topic : of the depth images. times : of each, nanoseconds. camera : a tree as a camera file holds it, or None.
    """

    topic: str
    times: tuple[int, ...]
    camera: dict[str, Any] | None


def is_bag(path: str | Path) -> bool:
    """Return whether this is a bag, or one frame of one."""
    found = FRAME.fullmatch(str(path))
    place = Path(found[1] if found else path)
    if place.suffix.lower() in SUFFIXES:
        return True
    return (place / "metadata.yaml").is_file() and any(next(place.glob(f"*{end}"), None) for end in SUFFIXES)


def bag_frames(path: str | Path, topic: str | None = None) -> dict[str, str]:
    """Return the names of a bag's frames by path; of a path that is one frame, that one."""
    if FRAME.fullmatch(str(path)):
        return {str(path): re.sub(r"[@/]", "_", Path(path).name)}
    times = _bag(str(path), topic).times
    wide = len(str(len(times) - 1))
    return {f"{path}@{k}": f"{Path(path).stem}/{k:0{wide}d}" for k in range(len(times))}


def read_frame(path: str, topic: str | None = None) -> tuple[np.ndarray, dict[str, Any] | None]:
    """Return a frame's depth image (H, W), uint16 units or float32 metres, and the tree of its camera or None.

    Raises DerenderError : no such bag, topic or frame, or images of another kind.
    """
    found = FRAME.fullmatch(path)
    if found is None:
        raise DerenderError("this is a bag of many frames", path, f"name one of them, such as {path}@0")
    place, number = found[1], int(found[2])
    bag = _bag(place, topic)
    if number >= len(bag.times):
        raise DerenderError(f"there are {len(bag.times)} depth images", path, "count from 0")
    with _opened(place) as reader:
        connections = [each for each in reader.connections if each.topic == bag.topic]
        repeated = bag.times[:number].count(bag.times[number])
        for connection, _, data in reader.messages(connections, start=bag.times[number]):
            if repeated == 0:
                return _depth_of(_message(reader, connection, data), path), bag.camera
            repeated -= 1
    raise AssertionError("the bag has changed while it was read")


@contextmanager
def _opened(path: str) -> Iterator[Any]:
    """Open a bag; what is wrong with it is a DerenderError."""
    needed = "reading bags needs rosbags", "pip install 'derender[ros]'", path
    bags, types = (optional(f"rosbags.{name}", *needed) for name in ("highlevel", "typesys"))
    try:
        kinds = types.get_typestore(types.Stores.ROS2_HUMBLE)
        with bags.AnyReader([Path(path)], default_typestore=kinds) as reader:
            yield reader
    except FileNotFoundError:
        raise DerenderError("cannot read the bag: No such file or directory", path, "check the path") from None
    except (bags.AnyReaderError, OSError, ValueError, KeyError, IndexError, AssertionError) as error:
        reason = " ".join(str(error).split())[:120]
        remedy = "play it and record it anew, or run `rosbag reindex`"
        raise DerenderError(f"the bag is damaged or no bag ({reason})", path, remedy) from error


@lru_cache(maxsize=8)
def _bag(path: str, topic: str | None) -> Bag:
    """Return the Bag of a file: every message's time is read once a process."""
    with _opened(path) as reader:
        topic = _depth_topic(reader, path, topic)
        connections = [each for each in reader.connections if each.topic == topic]
        times = tuple(time for _, time, _ in reader.messages(connections))
        camera = _camera(reader, topic)
    return Bag(topic, times, camera)


def _depth_topic(reader: Any, path: str, wanted: str | None) -> str:
    """Return the topic that is asked for, or the only one of depth images."""
    found = []
    for connection in reader.connections:
        if connection.msgtype in (IMAGES, COMPRESSED):
            message = _first(reader, connection)
            if message is not None and _encoding(message) in ENCODINGS:
                found.append(connection.topic)
    found = sorted(set(found))
    if wanted is None and len(found) == 1:
        return found[0]
    if wanted in found:
        return str(wanted)
    if not found:
        raise DerenderError("the bag has no depth images", path, "they are of 16UC1, mono16 or 32FC1")
    what = f"{len(found)} topics have depth images" if wanted is None else f"no depth images in topic {wanted}"
    raise DerenderError(what, path, "choose with --topic " + " or ".join(found))


def _first(reader: Any, connection: Any) -> Any:
    """Return the first message of a connection, or None."""
    for _, _, data in reader.messages([connection]):
        return _message(reader, connection, data)
    return None


def _message(reader: Any, connection: Any, data: bytes) -> Any:
    """Return a message. RealSense's SDK leaves bytes behind the end of images in .bag: they are cut off."""
    if connection.msgtype == IMAGES and not reader.is2:
        end = 12  # of the header's number and time; then come frame, height and width, encoding, order and step, pixels
        for between in (0, 8, 5):
            end += between
            end += 4 + int.from_bytes(data[end : end + 4], "little")
        data = data[:end]
    return reader.deserialize(data, connection.msgtype)


def _encoding(message: Any) -> str:
    """Return how a message encodes pixels: of a CompressedImage what it was before."""
    if hasattr(message, "format"):
        kind, _, how = message.format.partition(";")
        return kind.strip() if how.strip().startswith("compressedDepth") else ""
    return str(message.encoding)


def _camera(reader: Any, topic: str) -> dict[str, Any] | None:
    """Return the camera of a topic: the CameraInfo within whose namespace it lies, and RealSense's unit; None where
    there is none: that of another sensor, such as the colour camera's, is not its own."""
    within = {each.topic.rpartition("/")[0].removesuffix("/info"): each for each in reader.connections
              if each.msgtype == INFO}  # fmt: skip
    found = [space for space in within if topic.startswith(f"{space}/")]
    message = _first(reader, within[max(found, key=len)]) if found else None
    if message is None:
        return None
    fields = {key.lower(): getattr(message, key) for key in ("D", "K", "P", "d", "k", "p") if hasattr(message, key)}
    rectified = "rect" in topic  # the lens's distortion has been taken out: P is what is left
    matrix = np.reshape(fields["p"], (3, 4)) if rectified else np.reshape(fields["k"], (3, 3))
    tree = {"width": int(message.width), "height": int(message.height), "D": [] if rectified else fields["d"].tolist(),
            "fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2], "cy": matrix[1, 2],
            "distortion_model": "" if rectified else str(message.distortion_model), "binning_x": message.binning_x,
            "binning_y": message.binning_y, "roi": vars(message.roi)}  # fmt: skip
    for connection in reader.connections:
        if connection.topic.endswith(UNIT):
            with suppress(AttributeError, TypeError, ValueError):  # a Float32 in .bag, a String in .db3, or none
                if (unit := float(_first(reader, connection).data)) > 0:
                    tree["depth_scale"] = 1000.0 * unit
    return tree


def _depth_of(message: Any, path: str) -> np.ndarray:
    """Return the depth image of a message."""
    kind = np.dtype(ENCODINGS[_encoding(message)])
    if hasattr(message, "format"):
        return _uncompressed(bytes(message.data), kind, path)
    kind = kind.newbyteorder(">" if message.is_bigendian else "<")
    rows = np.asarray(message.data).reshape(message.height, message.step)[:, : message.width * kind.itemsize]
    return np.ascontiguousarray(rows).view(kind).astype(kind.newbyteorder("="))


def _uncompressed(data: bytes, kind: np.dtype, path: str) -> np.ndarray:
    """Return the depth image of compressedDepth: a PNG, of floats that of a / depth - b.

    Source: compressed_depth_image_transport of ROS.
    """
    picture = data[COMPRESSED_HEADER:]
    units = recognise(picture, path)[0](picture).array
    if kind.kind == "u":
        return units
    a, b = np.frombuffer(data[4:COMPRESSED_HEADER], "<f4")
    with np.errstate(divide="ignore"):
        return np.where(units > 0, a / (units.astype(np.float32) - b), 0.0).astype(np.float32)
