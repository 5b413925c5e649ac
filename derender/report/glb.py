"""GLB (binary glTF): the scene graph as nodes, each child under its parent; for viewers, Blender, game engines.

Written by hand, since the format is short: a JSON chunk and a chunk of numbers. glTF has y up and metres.
"""

import json
import struct
from typing import TYPE_CHECKING, Any

import numpy as np

from derender import __version__
from derender.report.geometry import solid_mesh, upright_pose
from derender.report.pictures import colours_of
from derender.scene.pose import quaternion, rotation_x

if TYPE_CHECKING:
    from derender.physics.verdict import Trajectory
    from derender.scene.graph import SceneGraph

FLOAT, UNSIGNED = 5126, 5125
VERTICES, TRIANGLES = 34962, 34963


def glb_bytes(graph: "SceneGraph", trajectory: "Trajectory | None" = None) -> bytes:
    """Return the scene as the bytes of a GLB.

    trajectory : moves its bodies, as an animation; objects that it does not name, nor planes, are left out.
    """
    solids, names = graph.solids(), graph.solid_names
    colours = colours_of(solids, graph.solid_names) / 255
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"derender {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [],
        "meshes": [],
        "materials": [],
        "accessors": [],
        "bufferViews": [],
    }
    data = bytearray()
    poses = graph.poses()
    up = rotation_x(-np.pi / 2) @ upright_pose(graph)
    tree["nodes"].append({"name": "root", "matrix": _column_major(up @ poses["root"]), "children": []})
    numbers = {"root": 0}
    for vertex in graph.vertices:
        relative = graph.relative_pose(vertex.name)
        number = numbers[vertex.name] = len(tree["nodes"])
        node: dict[str, Any] = {"name": vertex.name, "matrix": _column_major(relative)}
        tree["nodes"].append(node)
        tree["nodes"][numbers[vertex.parent]].setdefault("children", []).append(number)
        gone = trajectory is not None and vertex.shape != "plane" and vertex.name not in trajectory.names
        if vertex.name in names and not gone:
            index = names.index(vertex.name)
            node["mesh"] = len(tree["meshes"])
            _add_mesh(tree, data, vertex.name, *solid_mesh(solids, index), colours[index])
    if trajectory is not None:
        _add_animation(tree, data, graph, trajectory, numbers)
    tree["buffers"] = [{"byteLength": len(data)}]
    text = json.dumps(tree, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + bytes(data)
    return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body


def _add_mesh(
    tree: dict, data: bytearray, name: str, vertices: np.ndarray, triangles: np.ndarray, colour: np.ndarray
) -> None:
    # Every triangle has vertices of its own and no normals are given: glTF then asks for flat shading.
    points = vertices[triangles].reshape(-1, 3).astype("<f4")
    order = np.arange(len(points), dtype="<u4")
    accessors = []
    for array, kind, target in ((points, FLOAT, VERTICES), (order, UNSIGNED, TRIANGLES)):
        tree["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes, "target": target})
        entry: dict[str, Any] = {
            "bufferView": len(tree["bufferViews"]) - 1,
            "componentType": kind,
            "count": len(array),
            "type": "VEC3" if array.ndim == 2 else "SCALAR",
        }
        if array.ndim == 2:
            entry |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        tree["accessors"].append(entry)
        accessors.append(len(tree["accessors"]) - 1)
        data += array.tobytes()
    material = {"baseColorFactor": [*_linear(colour), 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
    tree["materials"].append({"name": name, "pbrMetallicRoughness": material, "doubleSided": True})
    primitive = {
        "attributes": {"POSITION": accessors[0]},
        "indices": accessors[1],
        "material": len(tree["materials"]) - 1,
    }
    tree["meshes"].append({"name": name, "primitives": [primitive]})


def _add_animation(tree: dict, data: bytearray, graph: "SceneGraph", trajectory: "Trajectory", numbers: dict) -> None:
    """Move each body's node: its pose in its parent's axes at each time, as a translation and a quaternion."""
    poses = {name: np.tile(pose, (len(trajectory.times), 1, 1)) for name, pose in graph.poses().items()}
    poses |= {name: trajectory.poses[:, k] for k, name in enumerate(trajectory.names)}
    times = _add_values(tree, data, trajectory.times.astype("<f4"), "SCALAR")
    channels: list[dict] = []
    samplers: list[dict] = []
    for vertex in graph.vertices:
        if vertex.name not in trajectory.names and vertex.parent not in trajectory.names:
            continue
        relative = np.linalg.inv(poses[vertex.parent]) @ poses[vertex.name]
        turns = np.array([quaternion(pose) for pose in relative])[:, [1, 2, 3, 0]]
        for k in range(1, len(turns)):  # the shorter way round from each frame to the next
            if turns[k] @ turns[k - 1] < 0:
                turns[k] *= -1.0
        node = tree["nodes"][numbers[vertex.name]]
        del node["matrix"]
        node |= {"translation": relative[0, :3, 3].tolist(), "rotation": turns[0].tolist()}
        for key, values, kind in (("translation", relative[:, :3, 3], "VEC3"), ("rotation", turns, "VEC4")):
            channels.append({"sampler": len(samplers), "target": {"node": numbers[vertex.name], "path": key}})
            output = _add_values(tree, data, np.ascontiguousarray(values, dtype="<f4"), kind)
            samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
    tree["animations"] = [{"name": "physics", "channels": channels, "samplers": samplers}]


def _add_values(tree: dict, data: bytearray, values: np.ndarray, kind: str) -> int:
    """Append numbers of an animation and return the number of their accessor."""
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes})
    entry = {"bufferView": len(tree["bufferViews"]) - 1, "componentType": FLOAT, "count": len(values), "type": kind}
    if kind == "SCALAR":
        entry |= {"min": [float(values.min())], "max": [float(values.max())]}
    tree["accessors"].append(entry)
    data += values.tobytes()
    return len(tree["accessors"]) - 1


def _linear(colour: np.ndarray) -> list[float]:
    """Return an sRGB colour as linear light, as glTF wants it."""
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4).tolist()


def _column_major(pose: np.ndarray) -> list[float]:
    return np.asarray(pose, float).T.ravel().tolist()
