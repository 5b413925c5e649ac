"""derender doctor: versions, which renderers work here, and what to install for those that do not."""

import importlib.metadata
import json
import os
import platform
import subprocess
import sys

import click

from derender import __version__
from derender.cli import options

PACKAGES = (
    "numpy scipy numba mujoco trimesh matplotlib click PyYAML imageio pillow OpenEXR pyrender PyOpenGL arviz".split()
)
# Draws a cube at 0.5 m and compares one depth; in a process of its own, since OpenGL's platform is chosen once in each
# and a broken driver may take the process with it.
CHECK = """
import sys
import numpy as np
from derender.errors import DerenderError
from derender.scene.solids import BOX, Solids
from derender.camera.intrinsics import Camera
from derender.render.renderers import find_renderer
pose = np.eye(4)[None].copy()
pose[0, 2, 3] = 0.55
cube = Solids(np.array([BOX], np.int32), pose, np.full((1, 3), 0.1), np.array([-1], np.int32))
try:
    depth, label = find_renderer(sys.argv[1]).render_depth(cube, Camera(60, 60, 31.5, 31.5, 64, 64))
except DerenderError as error:
    sys.exit(error.what)  # its remedy stands below
if abs(depth[32, 32] - 0.5) > 1e-4 or label[32, 32] != 0:
    sys.exit(f"it draws, but wrong: depth {depth[32, 32]:.4f} m where 0.5 is right")
"""
# Of each renderer its name, the platform of OpenGL that it is to use, and how to get it.
TRIALS = {
    "raycast": ("raycast", "", "reinstall derender and numba: pip install --force-reinstall derender numba"),
    "pyrender on OSMesa": ("pyrender", "osmesa", "apt-get install libosmesa6"),
    "pyrender on EGL": ("pyrender", "egl", "apt-get install libegl1 libgl1-mesa-dri libopengl0 libgl1"),
}


@click.command()
@options.as_json
def command(as_json: bool) -> int:
    """Say which versions and renderers work here, and what to install for those that do not.

    Exit status 1 where even raycast, which everything else needs, does not work.

    \b
    Examples:
        derender doctor
        derender doctor --json | python -m json.tool
    """
    versions = {"derender": __version__, "python": platform.python_version(), "system": platform.platform()}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    faults = {name: _try(renderer, opengl) for name, (renderer, opengl, _) in TRIALS.items()}
    renderers = {name: {"works": fault is None, "fault": fault, "remedy": fault and TRIALS[name][-1]}
                 for name, fault in faults.items()}  # fmt: skip
    if as_json:
        report = {"versions": versions, "processors": options.processors(), "renderers": renderers}
        click.echo(json.dumps(report, indent=1))
    else:
        for name, version in versions.items():
            click.echo(f"{name:<12} {version}")
        click.echo(f"{'processors':<12} {options.processors()}\n")
        for name, told in renderers.items():
            click.echo(f"{name:<20} " + ("works" if told["works"] else f"does not work: {told['fault']}"))
            if not told["works"]:
                click.echo(f"{'':<20} to get it: {told['remedy']}")
        if versions["arviz"] == "not installed":
            click.echo(f"{'arviz':<20} is optional, for posterior.nc: pip install 'derender[arviz]'")
    return 0 if faults["raycast"] is None else 1


def _try(renderer: str, opengl: str) -> str | None:
    """Return None where a renderer works in a process with this platform, else what is wrong, in one line."""
    environment = os.environ | ({"PYOPENGL_PLATFORM": opengl} if opengl else {})
    command = [sys.executable, "-P", "-c", CHECK, renderer]
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    except subprocess.TimeoutExpired:
        return "it did not draw within 2 minutes"
    if done.returncode == 0:
        return None
    lines = done.stderr.strip().splitlines()
    return lines[-1][:300] if lines else f"its process died ({done.returncode})"
