"""BOP's scene_gt.json: the pose of each solid in the camera's frame, millimetres; models_info.json with the sizes."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from derender.camera.intrinsics import Camera
    from derender.scene.graph import SceneGraph

MILLIMETRES = 1000.0


def export(graph: "SceneGraph", path: Path, camera: "Camera | None" = None) -> dict[str, bytes]:
    """Return the bytes of the scene_gt file, of models_info.json, and with a camera of scene_camera.json beside it."""
    poses = graph.poses()
    entries, models = [], {}
    for vertex in graph.vertices:
        size = vertex.body.size()
        if size is None:
            continue
        number = len(entries) + 1
        pose = poses[vertex.name]
        extent = np.asarray(size, float) * MILLIMETRES
        entries.append(
            {
                "cam_R_m2c": pose[:3, :3].ravel().tolist(),
                "cam_t_m2c": (pose[:3, 3] * MILLIMETRES).tolist(),
                "obj_id": number,
            }
        )
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
        matrix = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
        files["scene_camera.json"] = json.dumps({"0": {"cam_K": matrix, "depth_scale": camera.depth_scale}}, indent=1)
    return {name: (text + "\n").encode() for name, text in files.items()}
