"""What camera files hold, as one tree: JSON, YAML (OpenCV's too), .npy, and the lines of text that tools print.

Of text come: numbers alone (a matrix, or fx fy cx cy, with width and height before them in ARKitScenes), `name: value`
lines (RealSense's, ScanNet's, INI files), COLMAP's cameras.txt, and a RealSense profile as Python prints it.
"""

import codecs
import contextlib
import re
from io import BytesIO
from itertools import accumulate
from pathlib import Path

import numpy as np

from derender.camera.image_files import DAMAGE, MOST_BYTES, decode_npz, read_bytes
from derender.errors import DerenderError, at_fault
from derender.json_text import MOST_DEPTH, parse_json, without_duplicates

LARGEST_FILE = 16_000_000  # bytes; a camera file has a few hundred
NUMBERS = {4: ("fx", "fy", "cx", "cy"), 6: ("width", "height", "fx", "fy", "cx", "cy")}  # by how many stand alone
ZED_RAW = re.compile(r"^\[(LEFT|RIGHT)_CAM_", re.MULTILINE)
PRINTED = re.compile(r"\[\s*(\d+)x(\d+)\s+p\[(\S+) (\S+)\]\s+f\[(\S+) (\S+)\]\s*(.*?)\s*\[([^\]]*)\]\s*\]")  # RealSense
COLMAP = re.compile(r"^\s*(\d+) ([A-Z_]+) (\d+) (\d+)((?: \S+)+)\s*$", re.MULTILINE)
LINE = re.compile(r"\s*([A-Za-z][^:=,\[]*?)\s*[:=,]\s*(.*?)[\s,;]*")


def load_tree(
    path: str | Path, what: str = "the camera", remedy: str = "give a camera file, or a 3 x 3 matrix"
) -> object:
    """Return the tree of a file; the scalars of what is no JSON stay text, which `finite_number` reads.

    what, remedy : what the file should be, and what to do where it cannot be read.
    """
    most = MOST_BYTES if str(path).lower().endswith(".npz") else LARGEST_FILE  # a depth image with its camera
    data = read_bytes(path, most, what, remedy)
    try:
        with at_fault(path):
            if data.startswith(b"PK"):
                return decode_npz(data).camera
            if data.startswith(b"\x93NUMPY"):
                return np.load(BytesIO(data), allow_pickle=False).tolist()
            wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))  # as PowerShell's `>` writes
            text = data.decode("utf-16" if wide else "utf-8-sig")
            if text.lstrip().startswith("{"):
                try:
                    return parse_json(text)
                except DerenderError as error:
                    if not isinstance(error.__cause__, ValueError):  # else it is YAML in flow style
                        raise
            tree = _numbers(text) or _printed(text)
            return _yaml(text) if tree is None else tree
    except DAMAGE:
        raise DerenderError("neither JSON nor YAML", path, remedy) from None


def _yaml(text: str) -> object:
    """Return the tree of YAML, or of lines where it is none; ValueError where it is neither."""
    import yaml

    class Loader(getattr(yaml, "CBaseLoader", yaml.BaseLoader)):  # type: ignore[misc]
        def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
            without_duplicates([(key.value, None) for key, _ in node.value])
            return super().construct_mapping(node, deep)

    text = re.sub(r"\A%YAML[^\n]*", "", text)  # OpenCV's `%YAML:1.0` is no directive that YAML knows
    tree: object = None
    with contextlib.suppress(yaml.YAMLError):
        steps = (isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
                 for event in yaml.parse(text, Loader))  # fmt: skip
        if max(accumulate(steps), default=0) > MOST_DEPTH:  # building its tree would recurse, in C, without a limit
            raise ValueError
        tree = next(iter(yaml.load_all(text, Loader)), None)  # `rostopic echo` separates messages by ---
    if isinstance(tree, dict | list):
        return tree
    found = _numbers(re.sub(r"\b(array|dtype=\w+)|[\[\]()]", " ", text)) or _lines(text)  # the first as numpy prints
    if not found:
        raise ValueError
    return found


def _numbers(text: str) -> object:
    """Return the numbers of a text that holds no other words, as numpy.savetxt or tables write them; None otherwise."""
    words = re.sub("#.*|[,;]", " ", text).split()
    if len(words) not in (*NUMBERS, 9, 12, 16):
        return None
    with contextlib.suppress(ValueError):
        numbers = [float(word) for word in words]
        return dict(zip(NUMBERS[len(words)], numbers, strict=True)) if len(words) in NUMBERS else numbers
    return None


def _printed(text: str) -> object:
    """Return what a RealSense tool or COLMAP printed as a tree; None where the text is nothing of the kind.

    Raises DerenderError : the factory calibration of a ZED, which is not that of its images.
    """
    if ZED_RAW.search(text):
        what = "this is the raw calibration of a ZED, whose images are rectified"
        raise DerenderError(what, remedy="give the CameraParameters of left_cam that its SDK tells, as JSON")
    if found := PRINTED.fullmatch(text.strip()):
        names = ("width", "height", "ppx", "ppy", "fx", "fy", "model", "coeffs")
        return dict(zip(names, found.groups(), strict=True))
    if re.match(r"\s*width: *\d+, ", text):  # the same, of earlier versions
        return _yaml("{" + text.strip() + "}")
    cameras = {}
    for name, model, width, height, rest in COLMAP.findall(text):
        numbers = rest.split()
        numbers = numbers[:1] * model.startswith(("SIMPLE", "RADIAL")) + numbers  # one focal length for both
        cameras[name] = {"camera_model": model, "w": width, "h": height, "distortion": numbers[4:]}
        cameras[name] |= dict(zip(("fl_x", "fl_y", "cx", "cy"), numbers, strict=False))  # whose corners are COLMAP's
    return cameras or None


def _lines(text: str) -> dict[str, object]:
    """Return the names and values of lines `name: value`, `name = value` or `name,value`, where there are as many as a
    camera has; any other line is the name of those that follow."""
    sections: dict[str, list[tuple[str, object]]] = {"": []}
    name = ""
    for line in text.splitlines():
        found = LINE.fullmatch(line)
        if found:
            sections[name].append((found[1], found[2]))
        elif line.strip():
            name = line.strip(" []\t")
            sections.setdefault(name, [])
    if sum(map(len, sections.values())) < len(NUMBERS[4]):
        return {}
    top = without_duplicates(sections.pop(""))
    return top | {key: without_duplicates(pairs) for key, pairs in sections.items() if pairs}
