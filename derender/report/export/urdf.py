"""URDF for robot simulators: the floor and every solid a link, each on a floating joint from the world.

URDF knows boxes, spheres and cylinders; a mesh goes into an .obj beside the file. A plane is a thin box under it all.
"""

from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from derender.physics.bodies import DENSITY
from derender.report.geometry import plane_patch, solid_mesh, upright_pose
from derender.report.pictures import colours_of
from derender.scene import solids as kinds

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera
    from derender.scene.graph import SceneGraph

PLANE_THICKNESS = 0.01


def export(graph: "SceneGraph", path: Path, camera: "Camera | None" = None) -> dict[str, bytes]:
    """Return the bytes of the .urdf, and of an .obj for each mesh."""
    solids = graph.solids()
    up = upright_pose(graph)
    robot = ElementTree.Element("robot", name=path.stem)
    ElementTree.SubElement(robot, "link", name="world")
    files: dict[str, bytes] = {path.name: b""}
    for index, (name, colour) in enumerate(
        zip(graph.solid_names, colours_of(solids, graph.solid_names) / 255, strict=True)
    ):
        kind, size, pose = int(solids.kind[index]), solids.size[index], up @ solids.pose[index]
        fixed = kind == kinds.PLANE
        if fixed:
            patch, extent = plane_patch(solids, index)
            size = np.array([2 * extent, 2 * extent, PLANE_THICKNESS])
            pose = up @ patch
            pose[:3, 3] -= 0.5 * PLANE_THICKNESS * pose[:3, 2]
        link = ElementTree.SubElement(robot, "link", name=name)
        if not fixed:
            _add_inertia(link, kind, size, graph.vertex(name).options)
        for role in ("visual", "collision"):
            part = ElementTree.SubElement(link, role)
            geometry = ElementTree.SubElement(part, "geometry")
            if kind == kinds.SPHERE:
                ElementTree.SubElement(geometry, "sphere", radius=_text(0.5 * size[0]))
            elif kind == kinds.CYLINDER:
                ElementTree.SubElement(geometry, "cylinder", radius=_text(0.5 * size[0]), length=_text(size[2]))
            elif kind == kinds.MESH:
                file = f"{path.stem}_{name}.obj"
                files[file] = _obj(*solid_mesh(solids, index))
                ElementTree.SubElement(geometry, "mesh", filename=file)
            else:
                ElementTree.SubElement(geometry, "box", size=_text(*size))
            if role == "visual":
                material = ElementTree.SubElement(part, "material", name=f"{name}_colour")
                ElementTree.SubElement(material, "color", rgba=_text(*colour, 1.0))
        joint = ElementTree.SubElement(robot, "joint", name=f"{name}_joint", type="fixed" if fixed else "floating")
        ElementTree.SubElement(joint, "parent", link="world")
        ElementTree.SubElement(joint, "child", link=name)
        ElementTree.SubElement(joint, "origin", xyz=_text(*pose[:3, 3]), rpy=_text(*roll_pitch_yaw(pose)))
    ElementTree.indent(robot)
    files[path.name] = ElementTree.tostring(robot, xml_declaration=True, encoding="utf-8")
    return files


def roll_pitch_yaw(pose: np.ndarray) -> tuple[float, float, float]:
    """Return the turns about fixed x, y, z axes, in this order, that make up a rotation (URDF's rpy), radians."""
    rotation = pose[:3, :3]
    pitch = np.arctan2(-rotation[2, 0], np.hypot(rotation[0, 0], rotation[1, 0]))
    if np.hypot(rotation[0, 0], rotation[1, 0]) < 1e-9:
        # Looking straight up roll and yaw are one turn: all of it is roll.
        return float(np.arctan2(-rotation[1, 2], rotation[1, 1])), float(pitch), 0.0
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    return float(roll), float(pitch), float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _add_inertia(link, kind: int, size: np.ndarray, options) -> None:
    a, b, c = size
    volume = float(np.prod(size)) * {kinds.SPHERE: np.pi / 6, kinds.CYLINDER: np.pi / 4}.get(kind, 1.0)
    mass = options.get("mass") or volume * options.get("density", DENSITY)
    if kind == kinds.SPHERE:
        moments = np.full(3, mass * a * a / 10)
    elif kind == kinds.CYLINDER:
        across = mass * (3 * (a / 2) ** 2 + c * c) / 12
        moments = np.array([across, across, mass * (a / 2) ** 2 / 2])
    else:
        # A mesh is taken as its oriented box.
        moments = mass * np.array([b * b + c * c, a * a + c * c, a * a + b * b]) / 12
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "mass", value=_text(mass))
    inertia = ElementTree.SubElement(inertial, "inertia", ixy="0", ixz="0", iyz="0")
    for key, moment in zip(("ixx", "iyy", "izz"), moments, strict=True):
        inertia.set(key, _text(moment))


def _obj(vertices: np.ndarray, triangles: np.ndarray) -> bytes:
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"f {i} {j} {k}" for i, j, k in triangles + 1]
    return ("\n".join(lines) + "\n").encode()


def _text(*numbers: float) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)
