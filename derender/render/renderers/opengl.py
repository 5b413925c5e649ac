"""Depth and labels by OpenGL: pyrender on OSMesa or EGL, one off-screen renderer for the whole process.

This renderer is the independent witness for `raycast`. Its accuracy is that of a 24-bit depth buffer, so the near and
far planes are fitted to each scene.

This is the one place that imports pyrender and PyOpenGL. pyrender 0.1.45 is the last release and pins PyOpenGL 3.1.0,
which asks for the patches below; each says what it cures. They are harmless with newer PyOpenGL and with the fork
`pyrender2`, which Python 3.13 and later need.
"""

import ctypes
import ctypes.util
import functools
import os
import sys
import types
from collections.abc import Callable
from typing import Any

import numpy as np

from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.scene.solids import BOX, CYLINDER, MESH, PLANE, SPHERE, Solids

PLATFORMS = {"osmesa": "OSMesa", "egl": "EGL"}  # our order of preference, and the library that each needs
REMEDY = "install it (apt-get install libosmesa6, or libegl1 libgl1-mesa-dri libopengl0 libgl1), or use raycast"
# Constants of <GL/osmesa.h>
OSMESA_ATTRIBUTES = {
    "OSMESA_DEPTH_BITS": 0x30,
    "OSMESA_STENCIL_BITS": 0x31,
    "OSMESA_ACCUM_BITS": 0x32,
    "OSMESA_PROFILE": 0x33,
    "OSMESA_CORE_PROFILE": 0x34,
    "OSMESA_COMPAT_PROFILE": 0x35,
    "OSMESA_CONTEXT_MAJOR_VERSION": 0x36,
    "OSMESA_CONTEXT_MINOR_VERSION": 0x37,
}


def choose_platform() -> str:
    """Return "osmesa" or "egl": what PYOPENGL_PLATFORM names, else the first whose library is here.

    Raises DerenderError : neither library is installed.
    """
    named = os.environ.get("PYOPENGL_PLATFORM")
    if named in PLATFORMS:
        return named
    for platform, library in PLATFORMS.items():
        if ctypes.util.find_library(library):
            return platform
    raise DerenderError("OpenGL cannot draw here: neither OSMesa nor EGL is installed", remedy=REMEDY)


@functools.cache
def load_pyrender() -> types.ModuleType:
    """Import pyrender, patched; see the module's docstring.

    Raises DerenderError : pyrender or an OpenGL library is missing.
    """
    platform = choose_platform()
    os.environ["PYOPENGL_PLATFORM"] = platform
    try:
        # The viewer's pyglet wants X11 at import; nobody looks at a window here.
        viewer = types.ModuleType("pyrender.viewer")
        viewer.Viewer = None  # type: ignore[attr-defined]
        sys.modules.setdefault("pyrender.viewer", viewer)
        if not hasattr(np, "infty"):
            setattr(np, "infty", np.inf)  # noqa: B010  # pyrender's name, gone from numpy 2
        if platform == "osmesa":
            _patch_osmesa()
        import pyrender
        import pyrender.renderer
    except (ImportError, AttributeError, OSError) as error:
        why = ": ".join(str(part) for part in error.args[:2])  # PyOpenGL gives several
        raise DerenderError(f"OpenGL cannot draw here: {why}", f"pyrender on {platform}", REMEDY) from error
    # A multisample buffer is resolved to one off-centre sample: depth wrong by millimetres.
    pyrender.renderer.glRenderbufferStorageMultisample = _single_sample(pyrender.renderer.glRenderbufferStorage)
    return pyrender


def _single_sample(storage: Any) -> Callable[..., Any]:
    def allocate(target, samples, form, width, height):
        storage(target, form, width, height)

    return allocate


def _patch_osmesa() -> None:
    import OpenGL.osmesa
    import OpenGL.platform

    # As an opaque pointer a context is a new object at each call, so that PyOpenGL and pyrender's shader cache never
    # know it again: every draw recompiles and leaks. As an address it is equal to itself.
    current = OpenGL.platform.PLATFORM.GetCurrentContext
    current.restype = ctypes.c_void_p
    OpenGL.platform.GetCurrentContext = current
    OpenGL.platform.CurrentContextIsValid = current
    if hasattr(OpenGL.osmesa, "OSMesaCreateContextAttribs"):
        return
    # PyOpenGL 3.1.0 lacks the only call that gives a core profile.
    create = OpenGL.platform.PLATFORM.OSMesa.OSMesaCreateContextAttribs
    create.argtypes = [ctypes.POINTER(ctypes.c_int), ctypes.c_void_p]
    create.restype = OpenGL.osmesa.OSMesaContext
    OpenGL.osmesa.OSMesaCreateContextAttribs = lambda attributes, share: create(
        (ctypes.c_int * len(attributes))(*attributes), share
    )
    for name, value in OSMESA_ATTRIBUTES.items():
        setattr(OpenGL.osmesa, name, value)


FARTHEST = 100.0  # metres; a plane that runs to the horizon is cut off here
LARGEST_RATIO = 2000.0  # of far to near: what 24 bits resolve to better than a millimetre at FARTHEST / 20
SECTIONS = 256  # around a cylinder: sagitta 7.5e-5 of its radius
SUBDIVISIONS = 5  # of the sphere's icosahedron: 20,480 triangles, sagitta 2e-4 of its radius
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenCV's axes to OpenGL's


def render_depth(
    solids: Solids, camera: Camera, antialias: int = 1, background: float = np.nan
) -> tuple[np.ndarray, np.ndarray]:
    """Render depth and labels; the interface is the package's.

    Returns (depth, label).

    depth : (height, width) float64, metres along z; `background` where nothing is hit.
        With antialias n > 1 the mean over n x n samples a pixel.
    label : (height, width) int32, index into `solids` or -1; always from the sample at the pixel's centre,
        or next to it where antialias is even.

    Raises DerenderError : OpenGL does not work here; says what to install.
    """
    sampled = camera.downscaled(1 / antialias)
    depth, label = _shared_renderer(os.getpid()).draw(solids, sampled)
    depth[label < 0] = background
    if antialias == 1:
        return depth, label
    blocks = depth.reshape(camera.height, antialias, camera.width, antialias)
    middle = antialias // 2
    return blocks.mean(axis=(1, 3)), label[middle::antialias, middle::antialias].copy()


@functools.lru_cache(maxsize=1)
def _shared_renderer(process: int) -> "OpenGLRenderer":
    """Return this process's renderer: contexts do not survive a fork, and making many exhausts EGL."""
    return OpenGLRenderer()


class OpenGLRenderer:
    """A kept off-screen context and scene: a call moves the nodes that are there and draws."""

    def __init__(self) -> None:
        self.pyrender = load_pyrender()
        self.offscreen = self.pyrender.OffscreenRenderer(64, 64)
        # On OSMesa pyrender would make a new context for each image size; a frame buffer object needs none.
        self.offscreen._platform.supports_framebuffers = lambda: True
        self.scene = self.pyrender.Scene()
        self.eye = self.scene.add(self.pyrender.IntrinsicsCamera(1, 1, 0, 0), pose=FLIP)
        self.nodes: list[Any] = []
        self.keys: list[Any] = []

    def draw(self, solids: Solids, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return depth (0 where nothing is hit) and label of one sample a pixel."""
        if not len(solids.kind):
            return np.zeros(camera.shape), np.full(camera.shape, -1, dtype=np.int32)
        self._pose(solids, camera)
        number = {
            node: ((index + 1) & 255, (index + 1) >> 8 & 255, (index + 1) >> 16)
            for index, node in enumerate(self.nodes)
        }
        picture, depth = self.offscreen.render(self.scene, self.pyrender.RenderFlags.SEG, seg_node_map=number)
        label = picture.astype(np.int32) @ np.array([1, 256, 65536], dtype=np.int32) - 1
        return depth.astype(np.float64), label.astype(np.int32)

    def draw_depth(self, solids: Solids, camera: Camera) -> np.ndarray:
        """Return depth alone, (height, width) float32, 0 where nothing is hit: pyrender at its fastest."""
        self._pose(solids, camera)
        return self.offscreen.render(self.scene, self.pyrender.RenderFlags.DEPTH_ONLY)

    def _pose(self, solids: Solids, camera: Camera) -> None:
        """Bring the kept scene to these solids and this camera."""
        self.offscreen.viewport_width, self.offscreen.viewport_height = camera.width, camera.height
        near, far = clipping_planes(solids, camera)
        eye = self.eye.camera
        # OpenGL's pixel centres are at half integers.
        eye.fx, eye.fy, eye.cx, eye.cy = camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5
        eye.znear, eye.zfar = near, far
        keys = [self._key(solids, index) for index in range(len(solids.kind))]
        while len(self.nodes) > len(keys):
            self.scene.remove_node(self.nodes.pop())
            self.keys.pop()
        for index, key in enumerate(keys):
            matrix = _drawn_pose(solids, index, camera, far)
            if index == len(self.nodes):
                self.nodes.append(self.scene.add(self._mesh(key, solids, index), pose=matrix))
                self.keys.append(key)
                continue
            if self.keys[index] != key:
                self.scene.remove_node(self.nodes[index])
                self.nodes[index] = self.scene.add(self._mesh(key, solids, index), pose=matrix)
                self.keys[index] = key
            else:
                self.scene.set_pose(self.nodes[index], matrix)

    @staticmethod
    def _key(solids: Solids, index: int) -> tuple:
        kind = int(solids.kind[index])
        if kind != MESH:
            return (kind,)
        vertices, triangles = solids.meshes[solids.mesh[index]]
        return kind, vertices.tobytes(), triangles.tobytes()

    def _mesh(self, key: tuple, solids: Solids, index: int) -> Any:
        """Return the pyrender mesh of a key, kept while the scene shows it."""
        for known, node in zip(self.keys, self.nodes, strict=True):
            if known == key and node.mesh is not None:
                return node.mesh
        import trimesh

        kind = key[0]
        if kind == PLANE:
            corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
            shape = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
        elif kind == BOX:
            shape = trimesh.creation.box((1, 1, 1))
        elif kind == SPHERE:
            shape = trimesh.creation.icosphere(SUBDIVISIONS, radius=0.5)
        elif kind == CYLINDER:
            shape = trimesh.creation.cylinder(radius=0.5, height=1, sections=SECTIONS)
        else:
            vertices, triangles = solids.meshes[solids.mesh[index]]
            shape = trimesh.Trimesh(vertices, triangles, process=False)
        return self.pyrender.Mesh.from_trimesh(shape, smooth=kind == SPHERE)


def clipping_planes(solids: Solids, camera: Camera) -> tuple[float, float]:
    """Return near and far in metres that hold everything visible of the scene as tightly as is cheap to know."""
    nearest, farthest = FARTHEST, 1e-3
    for kind, pose, size in zip(solids.kind, solids.pose, solids.size, strict=True):
        if kind == PLANE:
            depths = _plane_depths(pose, camera)
            if not len(depths):
                continue
            low, high = depths.min(), depths.max()
        else:
            reach = float(np.abs(pose[2, :3]) @ size) / 2  # of the oriented box along z
            low, high = pose[2, 3] - reach, pose[2, 3] + reach
        nearest, farthest = min(nearest, low), max(farthest, high)
    far = min(max(farthest * 1.01, 0.01), FARTHEST * 1.01)
    near = max(nearest * 0.99, far / LARGEST_RATIO)
    return near, max(far, near * 1.01)


def _plane_depths(pose: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the depths at which a plane crosses the view at the corners of the image, FARTHEST at the horizon."""
    left, right = (-0.5 - camera.cx) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
    top, bottom = (-0.5 - camera.cy) / camera.fy, (camera.height - 0.5 - camera.cy) / camera.fy
    rays = np.array([[left, top, 1.0], [right, top, 1.0], [right, bottom, 1.0], [left, bottom, 1.0]])
    normal = pose[:3, 2]
    distance = normal @ pose[:3, 3]
    if distance == 0:
        return np.empty(0)
    inverse = rays @ normal / distance
    if inverse.max() <= 0:
        return np.empty(0)
    return 1 / np.maximum(inverse, 1 / FARTHEST)


def _drawn_pose(solids: Solids, index: int, camera: Camera, far: float) -> np.ndarray:
    """Return the matrix that takes the unit mesh of a solid's kind to the camera frame."""
    pose, size = solids.pose[index], solids.size[index]
    kind = solids.kind[index]
    if kind == PLANE:
        return _plane_patch(pose, camera, far)
    matrix = np.array(pose, dtype=float)
    if kind == MESH:
        vertices, _ = solids.meshes[solids.mesh[index]]
        extent = np.ptp(vertices, axis=0)
        size = np.divide(size, extent, out=np.ones(3), where=extent > 0)
    matrix[:3, :3] *= size
    return matrix


def _plane_patch(pose: np.ndarray, camera: Camera, far: float) -> np.ndarray:
    """Return the matrix of a square in the plane that covers what the camera sees of it, facing the camera.

    A patch that fits keeps single-precision rasterisation accurate; OpenGL culls a patch that faces away.
    """
    normal = pose[:3, 2]
    distance = normal @ pose[:3, 3]
    if distance > 0:  # the camera is behind: turn the patch about its x axis
        pose = pose @ FLIP
        normal, distance = -normal, -distance
    # The pyramid of sight up to `far`, cut by the plane: corners are where its eight edges cross it.
    left, right = (-0.5 - camera.cx) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
    top, bottom = (-0.5 - camera.cy) / camera.fy, (camera.height - 0.5 - camera.cy) / camera.fy
    base = far * np.array([[left, top, 1.0], [right, top, 1.0], [right, bottom, 1.0], [left, bottom, 1.0]])
    starts = np.vstack([np.zeros((4, 3)), base])
    ends = np.vstack([base, np.roll(base, -1, axis=0)])
    above, below = starts @ normal - distance, ends @ normal - distance
    crosses = above * below < 0
    if not crosses.any():
        return pose @ np.diag([1e-9, 1e-9, 1e-9, 1.0])  # not in sight
    share = (above / np.where(crosses, above - below, 1.0))[crosses, None]
    points = starts[crosses] + share * (ends[crosses] - starts[crosses])
    inside = (points - pose[:3, 3]) @ pose[:3, :2]
    low, high = inside.min(axis=0), inside.max(axis=0)
    middle, extent = (low + high) / 2, (high - low).max() * 1.02 + 1e-6
    placed = pose.copy()
    placed[:3, 3] += pose[:3, :2] @ middle
    return placed @ np.diag([extent, extent, 1.0, 1.0])
