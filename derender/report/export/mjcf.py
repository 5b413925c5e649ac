"""MJCF, MuJoCo's XML: the very model that `derender simulate` runs, turned upright; its meshes are inside the file."""

from pathlib import Path
from typing import TYPE_CHECKING

from derender.report.geometry import upright_pose
from derender.report.pictures import colours_of

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera
    from derender.scene.graph import SceneGraph


def export(graph: "SceneGraph", path: Path, camera: "Camera | None" = None) -> dict[str, bytes]:
    """Return the file's bytes by its name."""
    from derender.physics.bodies import Matter, matter_of_graph
    from derender.physics.mujoco_model import Units, World

    matter = matter_of_graph(graph)
    up = upright_pose(graph)
    bodies = tuple(body._replace(pose=up @ body.pose) for body in matter.bodies)
    world = World(Matter(bodies, up[:3, :3] @ matter.gravity, matter.supports), units=Units(1.0, 1.0, 1.0))
    colours = dict(zip(graph.solid_names, colours_of(graph.solids(), graph.solid_names) / 255, strict=True))
    for geom in world.spec.geoms:
        geom.rgba = [*colours[geom.name.split("/")[0]], 1.0]
    world.spec.worldbody.add_light(pos=[0.5, -1, 2], dir=[-0.25, 0.5, -1])
    return {path.name: world.to_xml(path.stem).encode()}
