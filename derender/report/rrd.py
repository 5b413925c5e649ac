"""A scene or a posterior as a log that rerun plays: the image, the best scene, and its chains draw by draw.

`rerun result.rrd` shows it; needs the package rerun-sdk (extra `rerun`).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from derender.atomic import atomic_path
from derender.camera.intrinsics import Camera
from derender.errors import DerenderError
from derender.report.geometry import plane_patch, solid_mesh
from derender.report.pictures import colours_of
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene import solids as kinds
from derender.scene.graph import SceneGraph

MOST_SCENES = 200  # draws of a chain that are shown as solids: its numbers are all there


def write_rrd(path: str | Path, graph: SceneGraph, posterior: Posterior | None = None,
              image: np.ndarray | None = None, camera: Camera | None = None) -> None:  # fmt: skip
    """Write a .rrd file: all in the camera's axes and metres, draws along the time line `draw`.

    Parameters
    ----------
    graph : the best scene. posterior : whose chains are shown, or None.
    image : (H, W) depth, metres, NaN where nothing returned, seen by `camera`.

    Raises
    ------
    DerenderError : rerun is not installed, or the file cannot be written.
    """
    try:
        import rerun
    except ImportError:
        raise DerenderError("rerun is not installed", path, "pip install 'derender[rerun]'") from None
    stream = rerun.RecordingStream("derender")
    with atomic_path(path) as temporary:
        stream.save(temporary)
        stream.log("world", rerun.ViewCoordinates.RDF, static=True)
        if camera is not None:
            matrix = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
            seen = rerun.Pinhole(image_from_camera=matrix, width=camera.width, height=camera.height)
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
        pose, extent = solids.pose[index], 1.0
        if solids.kind[index] == kinds.PLANE:
            pose, extent = plane_patch(solids, index)
        vertices, triangles = solid_mesh(solids, index, extent)
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
