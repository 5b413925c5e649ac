"""Wavefront OBJ with its materials: one object for each solid, z up, metres."""

from pathlib import Path
from typing import TYPE_CHECKING

from derender import __version__
from derender.report.geometry import plane_patch, solid_mesh, upright_pose
from derender.report.pictures import colours_of
from derender.scene import solids as kinds

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera
    from derender.scene.graph import SceneGraph


def export(graph: "SceneGraph", path: Path, camera: "Camera | None" = None) -> dict[str, bytes]:
    """Return the bytes of the .obj and of the .mtl beside it."""
    solids = graph.solids()
    up = upright_pose(graph)
    library = path.with_suffix(".mtl").name
    lines, materials, count = [f"# derender {__version__}: metres, z up", f"mtllib {library}"], [], 1
    for index, (name, colour) in enumerate(
        zip(graph.solid_names, colours_of(solids, graph.solid_names) / 255, strict=True)
    ):
        pose, extent = solids.pose[index], 1.0
        if solids.kind[index] == kinds.PLANE:
            pose, extent = plane_patch(solids, index)
        vertices, triangles = solid_mesh(solids, index, extent)
        placed = up @ pose
        word = name.replace(" ", "_")
        lines += [f"o {word}", f"usemtl {word}"]
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices @ placed[:3, :3].T + placed[:3, 3]]
        lines += [f"f {a} {b} {c}" for a, b, c in triangles + count]
        count += len(vertices)
        materials += [f"newmtl {word}", "Kd " + " ".join(f"{part:.4f}" for part in colour), ""]
    return {path.name: ("\n".join(lines) + "\n").encode(), library: "\n".join(materials).encode()}
