"""Depth files: each format as its tools write it, every fault in one line, round trips, and mutated files."""

import io
import json
import struct
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from derender.camera.depth_file import SUFFIXES, encode_npz, read_depth, turned, write_depth
from derender.camera.intrinsics import Camera
from derender.errors import DerenderError

FILES = Path(__file__).parent / "files"
CAMERA = Camera(5.0, 5.0, 1.5, 1.0, 4, 3)
# What the files were made of: 3 x 4, one pixel without a return.
TRUTH = np.arange(12).reshape(3, 4) / 16 + 0.5
TRUTH[0, 0] = np.nan


@pytest.mark.parametrize(
    "name", ["opencv_16bit.png", "imageio_16bit.png", "opencv_16bit.tiff", "tifffile_big_endian_16bit.tiff"]
)
def test_reads_16_bit_units_as_the_tool_writes_them(name):
    path = FILES / name
    image = read_depth(path)
    assert np.allclose(image.depth, TRUTH, atol=0.0005001, equal_nan=True)  # half a millimetre of rounding
    assert image.camera_is_guess
    assert np.allclose(read_depth(path, depth_scale=0.1).depth, image.depth / 10, equal_nan=True)
    tenth = Camera(5.0, 5.0, 1.5, 1.0, 4, 3, depth_scale=0.1)
    assert np.allclose(read_depth(path, tenth).depth, image.depth / 10, equal_nan=True)


@pytest.mark.parametrize("name", ["opencv_float.tiff", "tifffile_float.tiff", "tifffile_bigtiff_float.tiff"])
def test_reads_float_metres_as_the_tool_writes_them(name):
    assert np.array_equal(read_depth(FILES / name).depth, TRUTH, equal_nan=True)


@pytest.mark.parametrize("dtype", ["<f4", "<f8", ">f4", "<f2", "<u2", "<i4"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_reads_npy_as_numpy_writes_it(dtype, order, tmp_path):
    array = np.nan_to_num(TRUTH) * (1000 if dtype[1] in "ui" else 1)
    np.save(tmp_path / "depth.npy", np.asarray(array.round() if dtype[1] in "ui" else array, dtype=dtype, order=order))
    assert np.allclose(read_depth(tmp_path / "depth.npy").depth, TRUTH, atol=0.0005001, equal_nan=True)


@pytest.mark.parametrize("layout", ["Z", "V", "View Layer.Depth.Z", "grey", "with colour"])
@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("compression", ["ZIP", "ZIPS", "PIZ", "RLE", "NO"])
def test_reads_exr_as_renderers_write_it(layout, half, compression, tmp_path):
    import OpenEXR

    kind = np.float16 if half else np.float32
    pixels = np.nan_to_num(TRUTH, nan=np.inf if half else 1e10).astype(kind)  # Blender's sky
    if layout == "grey":
        channels = {name: pixels.copy() for name in "RGB"}
    elif layout == "with colour":
        colour = np.random.default_rng(0).random((3, 4)).astype(kind)
        channels = {"R": colour, "G": colour * 2, "B": colour * 3, "A": colour, "Z": pixels}
    else:
        channels = {layout: pixels}
    header = {"compression": getattr(OpenEXR, compression + "_COMPRESSION"), "type": OpenEXR.scanlineimage}
    path = tmp_path / "depth.exr"
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))
    assert np.array_equal(read_depth(path).depth, TRUTH.astype(kind).astype(float), equal_nan=True)


@pytest.mark.parametrize("far_plane", [1000.5, 5000.0, 65504.0, 1e10])
def test_a_renderers_far_plane_is_no_return(far_plane, tmp_path):
    pixels = np.where(np.isnan(TRUTH), far_plane, TRUTH)
    np.save(tmp_path / "depth.npy", pixels)
    assert np.array_equal(read_depth(tmp_path / "depth.npy").depth, TRUTH, equal_nan=True)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_written_is_read_back(suffix, tmp_path):
    path = tmp_path / f"depth{suffix}"
    write_depth(path, TRUTH, CAMERA)
    image = read_depth(path, None if suffix == ".npz" else CAMERA)
    assert np.allclose(image.depth, TRUTH, atol=0.0005001 if suffix == ".png" else 1e-7, equal_nan=True)
    assert image.camera == CAMERA and not image.camera_is_guess
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_an_npz_keeps_camera_meta_and_label_and_its_bytes_do_not_change(tmp_path):
    label = np.arange(12).reshape(3, 4)
    for name in ("a.npz", "b.npz"):
        write_depth(tmp_path / name, TRUTH, CAMERA, meta={"seed": 1}, label=label)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    image = read_depth(tmp_path / "a.npz")
    assert image.camera == CAMERA and image.meta == {"seed": 1}
    with np.load(tmp_path / "a.npz") as archive:  # any numpy reads it
        assert archive["depth"].dtype == np.float32 and archive["depth"][0, 0] == 0
        assert np.array_equal(archive["label"], label)
        assert json.loads(str(archive["camera"]))["fx"] == 5


def test_standard_streams_carry_whole_files(tmp_path, monkeypatch, capfdbinary):
    write_depth("-", TRUTH, CAMERA)
    data = capfdbinary.readouterr().out
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(data)))
    image = read_depth("-")
    assert np.allclose(image.depth, TRUTH, equal_nan=True) and image.camera == CAMERA
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"")))
    with pytest.raises(DerenderError, match="the file is empty"):
        read_depth("-")


def test_an_npz_is_a_camera_file_too(tmp_path):
    (tmp_path / "own.npz").write_bytes(encode_npz(TRUTH, CAMERA, {}))
    assert Camera.from_file(tmp_path / "own.npz") == CAMERA
    assert read_depth(TRUTH, tmp_path / "own.npz").camera == CAMERA
    np.savez(tmp_path / "none.npz", depth=TRUTH)
    (tmp_path / "cut.npz").write_bytes((tmp_path / "own.npz").read_bytes()[:60])
    for name in ("none.npz", "cut.npz"):
        with pytest.raises(DerenderError, match=f"{name}: "):
            Camera.from_file(tmp_path / name)


def test_an_npz_of_others_gives_its_intrinsic_matrix(tmp_path):
    np.savez(tmp_path / "a.npz", depth=TRUTH.astype(np.float32), K=np.array([[5, 0, 1.5], [0, 5, 1], [0, 0, 1]]))
    assert read_depth(tmp_path / "a.npz").camera == CAMERA


def test_a_depth_that_does_not_fit_16_bits_is_refused_and_nothing_is_left(tmp_path):
    with pytest.raises(DerenderError, match="does not fit into 16 bits"):
        write_depth(tmp_path / "a.png", np.full((3, 4), 70.0), CAMERA)
    with pytest.raises(DerenderError, match="choose from .npz"):
        write_depth(tmp_path / "a.jpg", TRUTH, CAMERA)
    with pytest.raises(DerenderError):
        write_depth("/proc/missing/a.npy", TRUTH, CAMERA)
    assert not list(tmp_path.iterdir())


def save(path, array):
    np.save(path, np.asarray(array), allow_pickle=True)


def colourised():
    """Return a picture (48, 64, 3) of a depth ramp in the colours of a rainbow."""
    hue = np.linspace(0.0, 4.0, 64) * np.ones((48, 1))
    return (255 * np.clip(np.stack([hue - 1.5, 2.0 - abs(hue - 2.0), 2.5 - hue], axis=-1), 0.0, 1.0)).astype(np.uint8)


FAULTS = {
    "missing": (lambda path: None, "No such file"),
    "a folder": (lambda path: path.mkdir(), "Is a directory"),
    "empty": (lambda path: path.write_bytes(b""), "the file is empty"),
    "text": (lambda path: path.write_bytes(b"not a picture"), "not a depth image that derender knows"),
    "jpeg": (lambda path: Image.new("L", (4, 3)).save(path, "JPEG"), "a JPEG is not a depth image"),
    "truncated png": (
        lambda path: path.write_bytes((FILES / "opencv_16bit.png").read_bytes()[:70]),
        "damaged or cut off",
    ),
    "truncated tiff": (lambda path: path.write_bytes((FILES / "opencv_float.tiff").read_bytes()[:40]), "cut off"),
    "truncated npy": (lambda path: (save(path, TRUTH), path.write_bytes(path.read_bytes()[:-9])), "cut off"),
    "8-bit": (lambda path: path.write_bytes((FILES / "opencv_8bit.png").read_bytes()), "8 bits a pixel"),
    "colour": (lambda path: path.write_bytes((FILES / "opencv_colour.png").read_bytes()), "a colour image"),
    "16-bit colour": (
        lambda path: path.write_bytes((FILES / "opencv_colour_16bit.png").read_bytes()),
        "a colour image",
    ),
    "colourised": (
        lambda path: Image.fromarray(colourised()).save(path, "PNG"),
        r"a colour image \(RGB\); give the raw depth image: one channel .* no picture to look at",
    ),
    "stretched": (
        lambda path: save(path, np.arange(48, dtype=np.uint16).reshape(6, 8) * 257),
        "8 bits a pixel, stretched to 16",
    ),
    "colour array": (lambda path: save(path, np.zeros((3, 4, 3), np.uint16)), "3 x 4 x 3; this looks like a colour"),
    "film": (lambda path: save(path, np.ones((3, 4, 5))), "3 x 4 x 5; a depth .* width, and --track follows a film"),
    "8-bit array": (lambda path: save(path, np.ones((3, 4), np.uint8)), "8 bits a pixel"),
    "flat array": (lambda path: save(path, np.ones(12)), "height x width"),
    "no pixels": (lambda path: save(path, np.ones((0, 4))), "0 x 4"),
    "complex array": (lambda path: save(path, np.ones((3, 4), complex)), "holds complex128"),
    "text array": (lambda path: save(path, np.full((3, 4), "x")), "holds <U1"),
    "pickle": (lambda path: save(path, np.array([[{}]], dtype=object)), "holds Python objects"),
    "all zeros": (lambda path: save(path, np.zeros((3, 4), np.float32)), "no pixel has a depth"),
    "all NaN": (lambda path: save(path, np.full((3, 4), np.nan)), "no pixel has a depth"),
    "all inf": (lambda path: save(path, np.full((3, 4), np.inf)), "no pixel has a depth"),
    "negative": (lambda path: save(path, -np.ones((3, 4))), "12 of 12 depths are negative"),
    "millimetres": (lambda path: save(path, 700 * np.ones((3, 4))), "--depth-scale"),
    "wrong size": (lambda path: save(path, np.ones((4, 4))), "the image is 4 x 4 pixels, its camera 4 x 3"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_one_clear_line_that_names_the_file(fault, tmp_path):
    make, message = FAULTS[fault]
    path = tmp_path / "image.npy"
    make(path)
    with pytest.raises(DerenderError, match=message) as caught:
        read_depth(path, CAMERA)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_a_saturated_pixel_of_16_bits_is_no_return(tmp_path):
    units = np.full((12, 16), 800, np.uint16)
    units[:3] = 65535
    Image.fromarray(units).save(tmp_path / "saturated.png")
    depth = read_depth(tmp_path / "saturated.png").depth
    assert np.isnan(depth[:3]).all() and np.allclose(depth[3:], 0.8)


def test_a_depth_scale_that_gives_metres_of_1e5_is_refused():
    with pytest.raises(DerenderError, match=r"opencv_16bit.png: the median depth is .* set --depth-scale"):
        read_depth(FILES / "opencv_16bit.png", depth_scale=1e5)
    with pytest.raises(DerenderError, match="--depth-scale"):
        read_depth(FILES / "opencv_16bit.png", depth_scale=1e-4)


def test_a_header_cannot_ask_for_memory_that_the_file_does_not_fill(tmp_path):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)})
    (tmp_path / "bomb.npy").write_bytes(stream.getvalue() + bytes(64))
    with pytest.raises(DerenderError, match="1000000000000 numbers announced"):
        read_depth(tmp_path / "bomb.npy")
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth.npy", stream.getvalue() + bytes(10**7))
    with pytest.raises(DerenderError, match="numbers announced"):
        read_depth(tmp_path / "bomb.npz")
    chunks = (b"IHDR" + struct.pack(">IIBBBBB", 60000, 60000, 16, 0, 0, 0, 0), b"IDAT")
    packed = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(packed))
    with pytest.raises(DerenderError, match="too many pixels"):
        read_depth(tmp_path / "bomb.png")


def whole_files():
    """Return one good file of each format, as bytes."""
    files = [path.read_bytes() for path in FILES.glob("*_*.*") if "8bit" not in path.name]
    stream = io.BytesIO()
    np.save(stream, TRUTH)
    from derender.camera.image_files import encode_exr

    exr = encode_exr(np.nan_to_num(TRUTH))
    return [*files, stream.getvalue(), encode_npz(np.nan_to_num(TRUTH), CAMERA, {"seed": 1}), exr]


WHOLE = whole_files()


def mutate(draw, content):
    """Return the bytes with a few changes: overwritten, cut out, put in, cut off."""
    content = bytearray(content)
    for _ in range(draw(st.integers(1, 5))):
        at = draw(st.integers(0, len(content)))
        new = draw(st.binary(max_size=6))
        content[at : at + draw(st.integers(0, 8))] = new
    if draw(st.booleans()):
        del content[draw(st.integers(0, len(content))) :]
    return bytes(content)


@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_a_mutated_file_never_gives_a_traceback(data, tmp_path):
    path = tmp_path / "image"
    path.write_bytes(mutate(data.draw, data.draw(st.sampled_from(WHOLE))))
    try:
        image = read_depth(path)
    except DerenderError as error:
        assert str(error).startswith(str(path)) and "\n" not in str(error)
    else:
        depth = image.depth[np.isfinite(image.depth)]
        assert image.depth.shape == image.camera.shape and depth.size and depth.min() > 0


@pytest.mark.parametrize("format", ["PNG", "TIFF"])
@pytest.mark.parametrize(("orientation", "turn"), [(1, 0), (6, 90), (3, 180), (8, 270)])
def test_what_exif_says_of_turning_is_done_to_image_and_camera(tmp_path, format, orientation, turn):
    units = np.arange(500, 620).astype(np.uint16).reshape(10, 12)
    camera = Camera(50.0, 60.0, 4.0, 7.0, 12, 10, gravity=(0.0, 1.0, 0.0))
    exif = Image.Exif()
    exif[274] = orientation
    Image.fromarray(units).save(tmp_path / "image", format, exif=exif)
    seen, wanted = read_depth(tmp_path / "image", camera), turned(read_depth(units, camera), turn)
    assert np.array_equal(seen.depth, wanted.depth) and seen.camera == wanted.camera
    exif[274] = 2
    Image.fromarray(units).save(tmp_path / "image", format, exif=exif)
    with pytest.raises(DerenderError, match="EXIF orientation mirrors"):
        read_depth(tmp_path / "image", camera)


def test_a_depth_of_nothing_is_no_return():
    """One pixel at 1e-300 m made NumPy warn of overflows, in lines that no user can read."""
    depth = np.full((24, 32), 0.9)
    depth[3, 4], depth[5, 6] = 1e-300, 5e-324
    assert np.isnan(read_depth(depth).depth[[3, 5], [4, 6]]).all()


def test_a_nan_of_another_kind_is_no_warning():
    """Flipped bits make signalling NaNs, of which a cast to float64 warns."""
    depth = np.full((24, 32), 0.9, np.float32)
    depth.view(np.uint32)[3, 4] = 0x7FA00000
    with warnings.catch_warnings(action="error"):
        assert np.isnan(read_depth(depth).depth[3, 4])


def tiff(pixels, order="<", compression=1, predictor=None, kind=3):
    """Return the bytes of a .tiff (H, W) of one strip: what Pillow does not write."""
    (tall, wide), bits = pixels.shape, 8 * pixels.dtype.itemsize
    more = [(317, 3, predictor)] if predictor else []
    entries = [(256, 4, wide), (257, 4, tall), (258, 3, bits), (259, 3, compression), (262, 3, 1), (273, 4, 0),
               (277, 3, 1), (278, 4, tall), (279, 4, 0), *more, (339, 3, kind)]  # fmt: skip
    data = pixels.astype(pixels.dtype.newbyteorder(order)).tobytes()
    if compression != 1:  # PackBits of runs of at most 128 bytes as they are
        data = b"".join(bytes([len(data[k : k + 128]) - 1]) + data[k : k + 128] for k in range(0, len(data), 128))
    first, lines = 8 + 2 + 12 * len(entries) + 4, b""
    for tag, type, value in entries:
        value = {273: first, 279: len(data)}.get(tag, value)
        lines += struct.pack(
            order + ("HHIHH" if type == 3 else "HHII"), tag, type, 1, value, *([0] if type == 3 else [])
        )
    head = b"II*\x00" if order == "<" else b"MM\x00*"
    return head + struct.pack(order + "IH", 8, len(entries)) + lines + struct.pack(order + "I", 0) + data


@pytest.mark.parametrize("order", "<>")
def test_a_tiff_of_64_bit_floats_is_read(tmp_path, order):
    """numpy's own floats, as tifffile writes them: Pillow reads none, and the file was called damaged."""
    depth = np.linspace(0.5, 1.5, 48 * 64).reshape(48, 64)
    (tmp_path / "depth.tiff").write_bytes(tiff(depth, order))
    assert np.array_equal(read_depth(tmp_path / "depth.tiff", Camera(60, 60, 31.5, 23.5, 64, 48)).depth, depth)
    assert read_depth(FILES / "tifffile_double.tiff").depth.dtype == float
    for wrong in (tiff(depth, order)[:-8], tiff(depth, order)[:40], tiff(depth, order, compression=32773)):
        (tmp_path / "depth.tiff").write_bytes(wrong)
        with pytest.raises(DerenderError, match="the picture is damaged, cut off, or of a rare kind"):
            read_depth(tmp_path / "depth.tiff")


def test_packbits_with_a_predictor_is_refused(tmp_path):
    """Pillow forgets the predictor: differences were taken for depths."""
    units = (1000 + np.arange(48 * 64).reshape(48, 64)).astype(np.uint16)
    for predictor, words in ((None, ""), (2, "PackBits with a predictor is not read")):
        (tmp_path / "depth.tiff").write_bytes(tiff(units, compression=32773, predictor=predictor, kind=1))
        if not words:
            assert np.allclose(read_depth(tmp_path / "depth.tiff").depth, units / 1000)
            continue
        with pytest.raises(DerenderError, match=words):
            read_depth(tmp_path / "depth.tiff")


class Held:
    """An array of another library, as torch's and xarray's are: numpy asks it for one."""

    def __init__(self, array):
        self.array = array

    def __array__(self, dtype=None, copy=None):
        return self.array if dtype is None else self.array.astype(dtype)


def test_intrinsics_and_images_may_be_arrays_of_any_library(tmp_path):
    """A matrix that is no numpy array was taken for the path of a file, and one of 4 x 4 was none."""
    depth = np.full((48, 64), 0.9)
    matrix = np.array([[60.0, 0, 31.5], [0, 61.0, 23.5], [0, 0, 1]])
    wide = np.eye(4)
    wide[:3, :3] = matrix
    for matrix_given in (
        matrix,
        matrix.tolist(),
        matrix.astype(object),
        np.asfortranarray(wide),
        Held(matrix),
        wide[:3],
    ):
        camera = read_depth(Held(depth), matrix_given).camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.shape) == (60, 61, 31.5, 23.5, (48, 64))
    counts = (1000 * depth).astype(np.uint16)
    assert read_depth(counts.astype(object), matrix).depth[0, 0] == 0.9  # as pandas keeps what may have gaps
    with pytest.raises(DerenderError, match="a Held is no camera; give a 3 x 3 matrix"):
        read_depth(depth, Held(np.array([[None] * 3] * 3)))


def test_a_unit_that_is_none_is_said_to_be_so():
    """It was said of the image that no pixel had a depth, or that all were negative."""
    counts = np.full((48, 64), 900, np.uint16)
    for wrong in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(DerenderError, match="depth-scale: it is .*; give millimetres for one unit"):
            read_depth(counts, depth_scale=wrong)
