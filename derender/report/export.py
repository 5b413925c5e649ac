"""Scenes in the formats of other programs, by suffix: glTF, OBJ, MJCF, URDF, BOP's and rerun's.

An exporter takes (graph, path, camera) and returns the files to write, bytes by name, the first of which is the one
asked for; others (a material library, meshes) go beside it.
"""

import json
import struct
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from derender import __version__
from derender.atomic import atomic_path, write_bytes
from derender.camera.intrinsics import Camera
from derender.errors import DerenderError, optional
from derender.physics.bodies import Matter, matter_of_graph
from derender.report.geometry import plane_patch, solid_mesh, upright_pose
from derender.report.pictures import colours_of
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene import solids as kinds
from derender.scene.graph import SceneGraph, relative_pose
from derender.scene.pose import quaternion, rotation_x

if TYPE_CHECKING:
    from derender.physics.verdict import Trajectory

MILLIMETRES = 1000.0
PLANE_THICKNESS = 0.01  # metres, of the box that stands for a plane in URDF


def export_scene(
    graph: SceneGraph, path: str | Path, camera: Camera | None = None, besides: Sequence[str] = (".rrd",)
) -> list[Path]:
    """Write a scene in the format of the suffix, and return the names of the files written.

    besides : suffixes that the caller takes too, to be told where this is none.

    Raises DerenderError : a suffix that none of the formats has, or a folder that cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in EXPORTERS:
        known = " ".join([*EXPORTERS, *besides])
        raise DerenderError(f"no format has the suffix {suffix!r}", path, f"choose from {known}")
    written = []
    for name, data in EXPORTERS[suffix](graph, path, camera).items():
        target = path.parent / name
        write_bytes(target, data)
        written.append(target)
    return written


def export_obj(graph: SceneGraph, path: Path, camera: Camera | None = None) -> dict[str, bytes]:
    """Return the bytes of a Wavefront .obj, one object for each solid, z up, and of the .mtl with its materials."""
    solids = graph.solids()
    up = upright_pose(graph)
    library = path.with_suffix(".mtl").name
    lines, materials, count = [f"# derender {__version__}: metres, z up", f"mtllib {library}"], [], 1
    for index, (name, colour) in enumerate(_coloured(graph, solids)):
        vertices, triangles = solid_mesh(solids, index)
        placed = up @ solids.pose[index]
        word = name.replace(" ", "_")
        lines += [f"o {word}", f"usemtl {word}"]
        lines += _triangles(vertices @ placed[:3, :3].T + placed[:3, 3], triangles, count)
        count += len(vertices)
        materials += [f"newmtl {word}", "Kd " + " ".join(f"{part:.4f}" for part in colour), ""]
    return {path.name: ("\n".join(lines) + "\n").encode(), library: "\n".join(materials).encode()}


def _coloured(graph: SceneGraph, solids: kinds.Solids) -> Iterable[tuple[str, np.ndarray]]:
    """Return name and colour (3,), from 0 to 1, of each solid."""
    return zip(graph.solid_names, colours_of(solids, graph.solid_names) / 255, strict=True)


def _triangles(vertices: np.ndarray, triangles: np.ndarray, first: int = 1) -> list[str]:
    """Return the lines of an .obj for vertices (V, 3) and triangles (T, 3); first : number of the first vertex."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    return lines + [f"f {a} {b} {c}" for a, b, c in triangles + first]


def export_mjcf(graph: SceneGraph, path: Path, camera: Camera | None = None) -> dict[str, bytes]:
    """Return the bytes of MuJoCo's XML, meshes and all: the very model that `derender simulate` runs."""
    from derender.physics.mujoco_model import Units, World

    matter = matter_of_graph(graph)
    up = upright_pose(graph)
    bodies = tuple(body._replace(pose=up @ body.pose) for body in matter.bodies)
    world = World(Matter(bodies, up[:3, :3] @ matter.gravity, matter.supports), units=Units(1.0, 1.0, 1.0))
    colours = dict(_coloured(graph, graph.solids()))
    for geom in world.spec.geoms:
        geom.rgba = [*colours[geom.name.split("/")[0]], 1.0]
    world.spec.worldbody.add_light(pos=[0.5, -1, 2], dir=[-0.25, 0.5, -1])
    return {path.name: world.to_xml(path.stem).encode()}


def export_urdf(graph: SceneGraph, path: Path, camera: Camera | None = None) -> dict[str, bytes]:
    """Return the bytes of the .urdf for robot simulators, and of an .obj for each mesh.

    The floor and every solid is a link, each on a joint from the world: fixed or floating. URDF knows boxes, spheres
    and cylinders; a mesh goes into an .obj beside the file. A plane is a thin box under it all.
    """
    solids = graph.solids()
    up = upright_pose(graph)
    masses = {body.name: body.weight_in_kg() for body in matter_of_graph(graph).bodies}
    robot = _element("robot", _element("link", name="world"), name=path.stem)
    files: dict[str, bytes] = {path.name: b""}
    for index, (name, colour) in enumerate(_coloured(graph, solids)):
        kind, size, pose = int(solids.kind[index]), solids.size[index], up @ solids.pose[index]
        fixed = kind == kinds.PLANE
        if fixed:
            patch, extent = plane_patch(solids, index)
            size = np.array([2 * extent, 2 * extent, PLANE_THICKNESS])
            pose = up @ patch
            pose[:3, 3] -= 0.5 * PLANE_THICKNESS * pose[:3, 2]
        form = "box", {"size": _text(*size)}
        if kind == kinds.SPHERE:
            form = "sphere", {"radius": _text(0.5 * size[0])}
        elif kind == kinds.CYLINDER:
            form = "cylinder", {"radius": _text(0.5 * size[0]), "length": _text(size[2])}
        elif kind == kinds.MESH:
            form = "mesh", {"filename": f"{path.stem}_{name}.obj"}
            text = "\n".join(_triangles(*solid_mesh(solids, index))) + "\n"
            files[form[1]["filename"]] = text.encode()
        shape = [_element("geometry", ElementTree.Element(*form)) for _ in range(2)]
        material = _element("material", _element("color", rgba=_text(*colour, 1.0)), name=f"{name}_colour")
        inertia = [] if fixed else [_inertial(kind, size, masses[name])]
        parts = *inertia, _element("visual", shape[0], material), _element("collision", shape[1])
        place = _element("origin", xyz=_text(*pose[:3, 3]), rpy=_text(*roll_pitch_yaw(pose)))
        ends = _element("parent", link="world"), _element("child", link=name), place
        joint = _element("joint", *ends, name=f"{name}_joint", type="fixed" if fixed else "floating")
        robot.extend([_element("link", *parts, name=name), joint])
    ElementTree.indent(robot)
    files[path.name] = ElementTree.tostring(robot, xml_declaration=True, encoding="utf-8")
    return files


def _element(tag: str, *inside: ElementTree.Element, **attributes: str) -> ElementTree.Element:
    """Return an element of XML with what is inside it."""
    element = ElementTree.Element(tag, attributes)
    element.extend(inside)
    return element


def roll_pitch_yaw(pose: np.ndarray) -> np.ndarray:
    """Return the turns about fixed x, y, z axes, in this order, that make up a rotation (URDF's rpy), radians."""
    from scipy.spatial.transform import Rotation

    with warnings.catch_warnings(action="ignore", category=UserWarning):  # straight up: roll and yaw are one turn
        return Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")


def _inertial(kind: int, size: np.ndarray, mass: float) -> ElementTree.Element:
    a, b, c = size
    if kind == kinds.SPHERE:
        moments = np.full(3, mass * a * a / 10)
    elif kind == kinds.CYLINDER:
        across = mass * (3 * (a / 2) ** 2 + c * c) / 12
        moments = np.array([across, across, mass * (a / 2) ** 2 / 2])
    else:  # a mesh is taken as its oriented box
        moments = mass * np.array([b * b + c * c, a * a + c * c, a * a + b * b]) / 12
    own = dict(zip(("ixx", "iyy", "izz"), map(_text, moments), strict=True))
    inertia = _element("inertia", ixy="0", ixz="0", iyz="0", **own)
    return _element("inertial", _element("mass", value=_text(mass)), inertia)


def _text(*numbers: float) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)


def export_bop(graph: SceneGraph, path: Path, camera: Camera | None = None) -> dict[str, bytes]:
    """Return the bytes of BOP's scene_gt file, the pose of each solid in the camera's frame in millimetres.

    Beside it models_info.json with the sizes, and with a camera scene_camera.json.
    """
    poses = graph.poses()
    entries, models = [], {}
    for vertex in graph.vertices:
        size = vertex.body.size()
        if size is None:
            continue
        number = len(entries) + 1
        pose = poses[vertex.name]
        extent, middle = np.asarray(size, float) * MILLIMETRES, pose[:3, 3] * MILLIMETRES
        entries.append({"cam_R_m2c": pose[:3, :3].ravel().tolist(), "cam_t_m2c": middle.tolist(), "obj_id": number})
        models[str(number)] = {
            # Of the box that holds it: the diameter of a sphere or cylinder is a little less.
            "diameter": float(np.linalg.norm(extent)),
            **{f"min_{axis}": float(-0.5 * length) for axis, length in zip("xyz", extent, strict=True)},
            **{f"size_{axis}": float(length) for axis, length in zip("xyz", extent, strict=True)},
            "name": vertex.name,
            "type": vertex.shape,
        }
    files = {path.name: json.dumps({"0": entries}, indent=1), "models_info.json": json.dumps(models, indent=1)}
    if camera is not None:
        told = {"cam_K": camera.matrix.ravel().tolist(), "depth_scale": camera.depth_scale}
        files["scene_camera.json"] = json.dumps({"0": told}, indent=1)
    return {name: (text + "\n").encode() for name, text in files.items()}


EXPORTERS: dict[str, Callable[[SceneGraph, Path, Camera | None], dict[str, bytes]]] = {
    ".glb": lambda graph, path, camera: {path.name: glb_bytes(graph)},
    ".obj": export_obj,
    ".xml": export_mjcf,
    ".urdf": export_urdf,
    ".json": export_bop,
}


# glTF by hand, since the format is short: a JSON chunk and a chunk of numbers. It has y up and metres.
FLOAT = 5126


def glb_bytes(graph: SceneGraph, trajectory: "Trajectory | None" = None) -> bytes:
    """Return the scene graph as the bytes of a GLB: nodes, each child under its parent.

    trajectory : moves its bodies, as an animation; objects that it does not name, nor planes, are left out.
    """
    solids, names = graph.solids(), graph.solid_names
    colours = colours_of(solids, graph.solid_names) / 255
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"derender {__version__}"},
        "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [], "meshes": [], "materials": [], "accessors": [], "bufferViews": [],
    }  # fmt: skip
    data = bytearray()
    poses = graph.poses()
    up = rotation_x(-np.pi / 2) @ upright_pose(graph)
    tree["nodes"].append({"name": "root", "matrix": _column_major(up @ poses["root"]), "children": []})
    numbers = {"root": 0}
    for vertex in graph.vertices:
        relative = relative_pose(vertex, graph.body(vertex.parent))
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
    points = _add_values(tree, data, vertices[triangles].reshape(-1, 3), "VEC3")
    light = np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)  # glTF wants it linear
    material = {"baseColorFactor": [*light.tolist(), 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.8}
    primitive = {"attributes": {"POSITION": points}, "material": len(tree["materials"])}
    tree["materials"].append({"name": name, "pbrMetallicRoughness": material, "doubleSided": True})
    tree["meshes"].append({"name": name, "primitives": [primitive]})


def _add_animation(tree: dict, data: bytearray, graph: SceneGraph, trajectory: "Trajectory", numbers: dict) -> None:
    """Move each body's node: its pose in its parent's axes at each time, as a translation and a quaternion."""
    poses = {name: np.tile(pose, (len(trajectory.times), 1, 1)) for name, pose in graph.poses().items()}
    poses |= {name: trajectory.poses[:, k] for k, name in enumerate(trajectory.names)}
    times = _add_values(tree, data, trajectory.times, "SCALAR")
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
            output = _add_values(tree, data, values, kind)
            samplers.append({"input": times, "output": output, "interpolation": "LINEAR"})
    tree["animations"] = [{"name": "physics", "channels": channels, "samplers": samplers}]


def _add_values(tree: dict, data: bytearray, values: np.ndarray, kind: str) -> int:
    """Append numbers and return the number of their accessor."""
    values = np.ascontiguousarray(values, dtype="<f4").reshape(len(values), -1)
    tree["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes})
    entry = {"bufferView": len(tree["bufferViews"]) - 1, "componentType": FLOAT, "count": len(values), "type": kind}
    tree["accessors"].append(entry | {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()})
    data += values.tobytes()
    return len(tree["accessors"]) - 1


def _column_major(pose: np.ndarray) -> list[float]:
    return np.asarray(pose, float).T.ravel().tolist()


MOST_SCENES = 200  # draws of a chain that are shown as solids: its numbers are all there


def write_rrd(path: str | Path, graph: SceneGraph, posterior: Posterior | None = None,
              image: np.ndarray | None = None, camera: Camera | None = None) -> None:  # fmt: skip
    """Write a .rrd file: all in the camera's axes and metres, draws along the time line `draw`.

    graph : the best scene. posterior : whose chains are shown, or None.
    image : (H, W) depth, metres, NaN where nothing returned, seen by `camera`.

    Raises DerenderError : rerun is not installed, or the file cannot be written.
    """
    rerun = optional("rerun", "rerun is not installed", "pip install 'derender[rerun]'", path)
    stream = rerun.RecordingStream("derender")
    with atomic_path(path) as temporary:
        stream.save(temporary)
        stream.log("world", rerun.ViewCoordinates.RDF, static=True)
        if camera is not None:
            seen = rerun.Pinhole(image_from_camera=camera.matrix, width=camera.width, height=camera.height)
            stream.log("world/camera", seen, static=True)
        if image is not None:
            depth = rerun.DepthImage(np.nan_to_num(image).astype(np.float32), meter=1.0)
            stream.log("world/camera/depth", depth, static=True)
        _log_scene(rerun, stream, "world/best", graph, static=True)
        if posterior is not None:
            _log_chains(rerun, stream, posterior.best_part)
        stream.flush()
        stream.disconnect()


def _log_scene(rerun: Any, stream: Any, place: str, graph: SceneGraph, static: bool = False,
               leave_out: Sequence[int] = ()) -> None:  # fmt: skip
    """Log each solid of a scene as a mesh under `place`; leave_out : kinds of solids that are not shown."""
    solids = graph.solids()
    for index, colour in enumerate(colours_of(solids, graph.solid_names)):
        if solids.kind[index] in leave_out:
            continue
        (vertices, triangles), pose = solid_mesh(solids, index), solids.pose[index]
        mesh = rerun.Mesh3D(vertex_positions=vertices @ pose[:3, :3].T + pose[:3, 3], triangle_indices=triangles,
                            albedo_factor=[*map(int, colour), 255])  # fmt: skip
        stream.log([*place.split("/"), graph.solid_names[index]], mesh, static=static)


def _log_chains(rerun: Any, stream: Any, part: StructurePosterior) -> None:
    """Log each chain's numbers at all draws, and its solids at no more than MOST_SCENES of them."""
    chains, draws = part.log_density.shape
    numbers = {"log_density": part.log_density, **{name: part.values[..., i] for i, name in enumerate(part.addresses)}}
    for chain in range(chains):
        when = rerun.TimeColumn("draw", sequence=np.arange(draws))
        for name, values in numbers.items():
            columns = rerun.Scalars.columns(scalars=values[chain])
            stream.send_columns(f"numbers/{name.replace('.', '/')}/chain_{chain + 1}", [when], columns)
        for draw in range(0, draws, -(-draws // MOST_SCENES)):
            stream.set_time("draw", sequence=draw)
            graph = part.graph_at(chain, draw)
            _log_scene(rerun, stream, f"world/chain_{chain + 1}", graph, leave_out=(kinds.PLANE,))
    stream.reset_time()
