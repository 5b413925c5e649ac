"""Camera files as OpenCV, ORB-SLAM, RealSense's tools, COLMAP, NeRF, ScanNet and others write them: read, or refused.

Most hold one camera, fx 615.5, fy 616.5, cx 318.25, cy 241.75 of 640 x 480 pixels; with distortion, or of a fisheye, it
was taken for a pinhole camera's in silence where the tool calls it by another name than ROS does.
"""

import json
import time

import pytest

from derender.camera.camera_file import read_camera
from derender.errors import DerenderError

PINHOLE = (615.5, 616.5, 318.25, 241.75)
K = [615.5, 0, 318.25, 0, 616.5, 241.75, 0, 0, 1]
FOUR = dict(zip(("fx", "fy", "cx", "cy"), PINHOLE, strict=True))
CORNERS = {"fl_x": 615.5, "fl_y": 616.5, "cx": 318.75, "cy": 242.25, "w": 640, "h": 480}
OPENCV = """%YAML:1.0
---
calibration_time: "Mon 01 Jan 2024 10:00:00 AM CET"
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.155e+02, 0., 3.1825e+02, 0., 6.165e+02, 2.4175e+02, 0.,
       0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0., 0., 0., 0., 0. ]
"""
ORB_SLAM = """%YAML:1.0

# Camera Parameters. Adjust them!
Camera.type: "PinHole"
Camera.fx: 615.5
Camera.fy: 616.5
Camera.cx: 318.25
Camera.cy: 241.75
Camera.k1: 0.0
Camera.p1: 0.0
Camera.width: 640
Camera.height: 480
DepthMapFactor: 5000.0
ORBextractor.nFeatures: 1000
"""
ENUMERATED = """ Intrinsic of "Depth" / 640x480 / {Z16}
  Width:      \t640
  Height:     \t480
  PPX:        \t318.25
  PPY:        \t241.75
  Fx:         \t615.5
  Fy:         \t616.5
  Distortion: \tBrown Conrady
  Coeffs:     \t0  \t0  \t0  \t0  \t0  
  FOV (deg):  \t54.95 x 42.54

"""  # noqa: W291
VIEWER = """Frame Info:
Type,Depth
Resolution x,640
Resolution y,480

Intrinsic:,
Fx,615.500000
Fy,616.500000
PPx,318.250000
PPy,241.750000
Distorsion,Brown Conrady
"""
PRINTED = "[ 640x480  p[318.25 241.75]  f[615.5 616.5]  Inverse Brown Conrady [0 0 0 0 0] ]\n"
COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 PINHOLE 640 480 615.5 616.5 318.75 242.25
"""
SCANNET = """axisAlignment = 0.945519 0.325568 0.000000 -5.384390
colorHeight = 968
colorWidth = 1296
depthHeight = 480
depthWidth = 640
fx_color = 1170.187988
fx_depth = 615.5
fy_depth = 616.5
mx_depth = 318.25
my_depth = 241.75
"""
KALIBR = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0, 0, 0, 0]
  distortion_model: radtan
  intrinsics: [615.5, 616.5, 318.25, 241.75]
  resolution: [640, 480]
"""
ZIVID = """CameraIntrinsics:
  CameraMatrix: {CX: 318.25, CY: 241.75, FX: 615.5, FY: 616.5}
  Distortion: {K1: 0, K2: 0}
"""
NUMPY = "array([[615.5 ,   0.  , 318.25],\n       [  0.  , 616.5 , 241.75],\n       [  0.  ,   0.  ,   1.  ]])\n"
DEPTH_AND_COLOUR = {"color": {"fx": 900, "fy": 900, "ppx": 310, "ppy": 250}, "depth": {"fx": 600, "fy": 600, "ppx": 318,
                    "ppy": 241}}  # fmt: skip
FRAMES = {"frames": [{"depth_file_path": f"depth/{name}.png", **CORNERS, "fl_x": focal} for name, focal in
                     (("other", 700.0), ("frame_1", 615.5))]}  # fmt: skip
READ = {
    "OpenCV": OPENCV,
    "OpenCV, old": OPENCV.replace("camera_matrix", "Camera_Matrix").replace("image_width", "image_Width"),
    "OpenCV, as people call it": OPENCV.replace("camera_matrix", "cameraMatrix"),
    "OpenCV, JSON": {"camera_matrix": {"type_id": "opencv-matrix", "rows": 3, "cols": 3, "dt": "d", "data": K}},
    "RealSense, enumerated": ENUMERATED,
    "RealSense, several": ENUMERATED.replace("640", "848").replace("615.5", "424.5") + ENUMERATED,
    "RealSense, the viewer's": VIEWER,
    "RealSense, printed": PRINTED,
    "RealSense, printed of old": "width: 640, height: 480, ppx: 318.25, ppy: 241.75, fx: 615.5, fy: 616.5, "
    "model: Brown Conrady, coeffs: [0, 0, 0, 0, 0]\n",
    "COLMAP": COLMAP,
    "COLMAP, larger colours": "1 OPENCV 1280 960 1231 1233 637.5 484.5 0 0 0 0\n",
    "ScanNet": SCANNET,
    "Kalibr": KALIBR,
    "Zivid": ZIVID,
    "instant-ngp": {"camera_angle_x": 0.9, **CORNERS, "k1": 0, "is_fisheye": False, "frames": []},
    "Nerfstudio, a camera a frame": FRAMES,
    "ARKitScenes": "640 480 615.5 616.5 318.25 241.75\n",
    "four numbers": "# fx fy cx cy\n615.5 616.5 318.25 241.75\n",
    "Open3D, by rows": {"width": 640, "height": 480, "intrinsic_matrix": K},
    "numpy, printed": NUMPY.replace("array(", "").replace(")", "").replace(",", ""),
    "numpy, its repr": NUMPY,
    "a size around it": {"width": 640, "height": 480, "intrinsics": FOUR},
    "two sizes": {"color": {"fx": 900, "fy": 900, "ppx": 640, "ppy": 360, "width": 1280, "height": 720},
                  "depth": {"fx": 615.5, "fy": 616.5, "ppx": 318.25, "ppy": 241.75, "width": 640, "height": 480}},
}  # fmt: skip
UNITS = {
    "ORB-SLAM": (ORB_SLAM, 0.2),
    "ORB-SLAM 3": (ORB_SLAM.replace("Camera.", "Camera1.").replace("Depth", "RGBD.Depth"), 0.2),
    "Replica": ({"camera": {"w": 640, "h": 480, **FOUR, "scale": 6553.5}}, 1000 / 6553.5),
    "NICE-SLAM": ({"cam": {"H": 480, "W": 640, **FOUR, "png_depth_scale": 5000.0}}, 0.2),
    "a matrix with a unit": ({"K": K, "depth_scale": 0.25}, 0.25),
    "metres to a unit": ({**FOUR, "depth_scale": 0.001}, 1.0),
    "the scale of a picture": ({**FOUR, "scale": 0.5}, 1.0),
}
DISTORTED = {
    "OpenCV": OPENCV.replace("[ 0.,", "[ 0.1,"),
    "OpenCV, old": OPENCV.replace("[ 0.,", "[ 0.1,").replace("distortion_c", "Distortion_C"),
    **{key: {"K": K, key: [[0.1, 0, 0, 0, 0]]} for key in ("dist", "dist_coeff", "distCoeffs", "distortion_coeffs")},
    "MATLAB": {**FOUR, "radial_distortion": [0.1, 0], "tangential_distortion": [0, 0]},
    "YAML": "fx: 615\nfy: 616\ncx: 318\ncy: 241\nk1: 0.1\n",  # whose scalars are text
    "not a number": "fx: 615\nfy: 616\ncx: 318\ncy: 241\nD: [.nan]\n",
    "ORB-SLAM": ORB_SLAM.replace("k1: 0.0", "k1: 0.26"),
    "enumerated": ENUMERATED.replace("Coeffs:     \t0", "Coeffs:     \t0.1"),
    "printed": PRINTED.replace("[0 0", "[0.1 0"),
    "COLMAP": "1 SIMPLE_RADIAL 640 480 615.5 318.75 242.25 0.01\n",
    "Kalibr": KALIBR.replace("[0, 0", "[-0.27, 0"),
    "beside the matrix": ZIVID.replace("K1: 0", "K1: -0.27"),
    "INI": "[DepthIntrinsic]\nfx=615.5\nfy=616.5\ncx=318.25\ncy=241.75\n[DepthDistortion]\nk1=0.1\n",
    "cut off": "K: [615, 0, 318, 0, 615, 240, 0, 0, 1]\nwidth: 640\nheight: 480\nD: [0.1, 0",
}
REFUSED = {
    "COLMAP, fisheye": ("1 OPENCV_FISHEYE 640 480 615 616 318 242 0 0 0 0\n", "no pinhole camera; rectify first"),
    "Nerfstudio, fisheye": ({**CORNERS, "camera_model": "OPENCV_FISHEYE"}, "no pinhole camera; rectify first"),
    "instant-ngp, fisheye": ({**CORNERS, "is_fisheye": True}, "no pinhole camera; rectify first"),
    "ROS, fisheye": ({"K": K, "D": [0, 0, 0, 0], "distortion_model": "equidistant"}, "no pinhole camera"),
    "ORB-SLAM, fisheye": (ORB_SLAM.replace("PinHole", "KannalaBrandt8"), "no pinhole camera; rectify first"),
    "ZED": ("[LEFT_CAM_2K]\nfx=1400\nfy=1400\ncx=1103\ncy=620\nk1=-0.17\n", "raw calibration of a ZED.*left_cam"),
    "depth and colour": (DEPTH_AND_COLOUR, "different cameras: color, depth; .* where depth was aligned"),
    "two of COLMAP": (COLMAP + "2 PINHOLE 640 480 700 700 320 240\n", "different cameras: 1, 2"),
    "a key twice": ("fx: 615\nfy: 616\ncx: 318\ncy: 241\nfx: 700\n", "'fx' stands twice"),
    "prose": ("This is a readme\nName: x\nUse: y\nSee: z\nAlso: q\n", "no camera in the keys This is a readme"),
    "NeRF, in degrees": ({"camera_angle_x": 57.0, "frames": []}, "a field of view in radians"),
}  # fmt: skip


def camera_of(content, tmp_path):
    (tmp_path / "camera.txt").write_text(content if isinstance(content, str) else json.dumps(content))
    return read_camera(tmp_path / "camera.txt", (480, 640), "frame_1")


@pytest.mark.parametrize("name", READ)
def test_a_camera_is_read_as_the_tool_writes_it(name, tmp_path):
    camera = camera_of(READ[name], tmp_path)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(PINHOLE)
    assert (camera.shape, camera.depth_scale) == ((480, 640), 1.0)


@pytest.mark.parametrize("name", UNITS)
def test_the_unit_of_depth_is_read_with_it(name, tmp_path):
    """ORB-SLAM's and Replica's depth is in units to the metre: taken for millimetres all is five times as large."""
    content, unit = UNITS[name]
    camera = camera_of(content, tmp_path)
    assert (camera.fx, camera.cy, camera.depth_scale) == pytest.approx((615.5, 241.75, unit))


def test_nerf_s_field_of_view_is_that_of_the_whole_image(tmp_path):
    """Blender's film is centred: its middle is the corner between the four pixels in the middle."""
    camera = camera_of({"camera_angle_x": 1.0, "frames": [{"file_path": "r_0", "transform_matrix": []}]}, tmp_path)
    assert camera.field_of_view == pytest.approx(57.29577951)
    assert (camera.fy, camera.cx, camera.cy) == (camera.fx, 319.5, 239.5)
    both = camera_of({"camera_angle_x": 1.0, "camera_angle_y": 0.9, "w": 1280, "h": 960}, tmp_path)
    assert (both.fx, both.shape) == (pytest.approx(camera.fx), (480, 640)) and both.fy > both.fx * 0.8


@pytest.mark.parametrize("name", DISTORTED)
def test_distortion_is_refused_whatever_it_is_called(name, tmp_path):
    with pytest.raises(DerenderError, match=r"the camera has distortion .*; rectify first") as caught:
        camera_of(DISTORTED[name], tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_pinhole_or_not_the_image_s_own_is_refused(name, tmp_path):
    content, words = REFUSED[name]
    with pytest.raises(DerenderError, match=words) as caught:
        camera_of(content, tmp_path)
    assert "\n" not in str(caught.value)


def test_yaml_that_names_a_list_again_and_again_ends(tmp_path):
    started = time.process_time()
    with pytest.raises(DerenderError, match="no camera in the keys a, b"):
        camera_of("a: &a [" + "[]," * 20_000 + "[]]\nb: [" + "*a," * 20_000 + "*a]\n", tmp_path)
    assert time.process_time() - started < 10  # four hundred million lists, walked one by one
