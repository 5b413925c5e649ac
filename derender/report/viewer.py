"""The scene of a report in three dimensions: what viewer.js draws."""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

from derender.render.raycast.depth import render_depth
from derender.report import pictures
from derender.report.contents import Report
from derender.report.geometry import solid_mesh
from derender.scene import solids as kinds
from derender.scene.shapes.kinds import CORNERS
from derender.scene.solids import Solids

HERE = Path(__file__).parent
SHOWN_POINTS = 12_000
STILL = 320  # columns, about, of the picture that stands in where a browser draws nothing in three dimensions
# The greatest contact force is as long as the greatest extent of a solid, and a tenth of that wide at its tail.
FORCE_LENGTH, FORCE_WIDTH = 1.0, 0.1
FORCE_COLOUR = (200, 0, 170)  # which no object is named after
HUGE = 1e9  # newtons or metres: no simulation tells more


def viewer_html(report: Report, colours: np.ndarray) -> str:
    """Return the viewer of a report's scene: canvas, switches, data and script."""
    points, point_colours = _observed_points(report, colours)
    shown, near = [], _without_far_points(points)
    for index, kind in enumerate(report.solids.kind):
        pose = report.solids.pose[index]
        vertices, triangles = solid_mesh(report.solids, index, near)
        shown.append(
            {
                "vertices": _base64((vertices @ pose[:3, :3].T + pose[:3, 3]).astype("<f4")),
                "triangles": _base64(triangles.astype("<u4")),
                "colour": colours[index].tolist(),
                "name": report.solid_names[index] if kind != kinds.PLANE else None,
            }
        )
    extended = report.solids.kind != kinds.PLANE
    centres = report.solids.pose[extended if extended.any() else slice(None), :3, 3]
    target = centres.mean(axis=0) if len(centres) else np.array([0.0, 0.0, 1.0])
    fov = np.deg2rad(45) if report.camera is None else 2 * np.arctan(0.5 * report.camera.height / report.camera.fy)
    data: dict[str, Any] = {
        "solids": shown,
        "target": target.tolist(),
        "up": (-np.asarray(report.scene["gravity"], float)).tolist(),
        "fov": float(fov),
    }
    if len(points):
        data["points"] = {"positions": _base64(points.astype("<f4")), "colours": _base64(point_colours)}
    ghosts = [_outline(draw, index) for draw in report.draws for index in range(len(draw.kind))]
    lines = np.concatenate([line for line in ghosts if len(line)] or [np.zeros((0, 3))])
    if len(lines):
        data["ghosts"] = {
            "positions": _base64(lines.astype("<f4")),
            "colours": _base64(np.full(lines.shape, 40, dtype=np.uint8)),
        }
    needles = _needles(report)
    if len(needles):
        colour = np.tile(np.array(FORCE_COLOUR, np.uint8), (len(needles), 1))
        data["forces"] = {"positions": _base64(needles.astype("<f4")), "colours": _base64(colour)}
    text = json.dumps(data).replace("</", "<\\/")
    still = "data:,"
    if report.camera is not None:
        small = report.camera.downscaled(max(1, round(report.camera.width / STILL)))
        still = pictures.png_uri(pictures.shade(report.solids, small, report.solid_names, samples=1))
    return f"""<canvas id="scene" tabindex="0" role="img" aria-label="The scene in three dimensions"></canvas>
<img id="still" alt="The scene" src="{still}" style="display:none;width:100%">
<p><label><input type="checkbox" id="show-solids" checked> solids</label>
<label {"" if len(points) else "hidden"}><input type="checkbox" id="show-points" checked> observed points</label>
<label {"" if len(lines) else "hidden"}><input type="checkbox" id="show-ghosts"> posterior draws</label>
<label {"" if len(needles) else "hidden"}><input type="checkbox" id="show-forces" checked> contact forces</label>
<span class="soft">drag or arrow keys to turn, wheel or + and − to zoom, shift-drag to move, double click or 0 to go
back</span></p>
<script type="application/json" id="scene-data">{text}</script>
<script>{(HERE / "viewer.js").read_text()}
(() => {{
  const get = name => document.getElementById(name);
  const works = showScene(get("scene"), JSON.parse(get("scene-data").textContent),
    {{solids: get("show-solids"), points: get("show-points"), ghosts: get("show-ghosts"), forces: get("show-forces")}});
  if (!works) {{ get("scene").style.display = "none"; get("still").style.display = "block"; }}
}})();</script>"""


def _observed_points(report: Report, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return some observed points, (P, 3) in the camera's frame, and their colours: that of what explains them."""
    if report.camera is None or report.observed is None:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    _, label = render_depth(report.solids, report.camera)
    rows, columns = np.nonzero(np.isfinite(report.observed))
    step = max(1, -(-len(rows) // SHOWN_POINTS))
    rows, columns = rows[::step], columns[::step]
    points = report.camera.points(report.observed)[rows, columns]
    owner = label[rows, columns]
    # Darker than the solids, so that points on a surface can be seen.
    shades = np.vstack([(0.55 * colours), [[120, 120, 120]]]).astype(np.uint8)
    return points, np.ascontiguousarray(shades[owner])


def _without_far_points(points: np.ndarray) -> np.ndarray:
    """Return the points without the farthest twentieth: one stray return must not make a plane a kilometre wide."""
    if not len(points):
        return points
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return points[distance <= np.percentile(distance, 95)]


def _needles(report: Report) -> np.ndarray:
    """Return the contact forces that a simulation tells as needles, whose tips are where they act: (12 F, 3) corners
    of their triangles, in the camera's frame."""
    try:
        told = [(each["point"], each["force"]) for each in report.simulated.get("forces") or ()]
        found = np.array(told, dtype=float).reshape(-1, 2, 3)
    except (TypeError, ValueError, KeyError):  # the file may be of anyone's making
        return np.zeros((0, 3))
    tips, forces = found[(np.abs(found).max(axis=(1, 2)) < HUGE) & found[:, 1].any(axis=1)].transpose(1, 0, 2)
    strength = np.linalg.norm(forces, axis=1, keepdims=True)
    longest = FORCE_LENGTH * float(np.max(report.solids.size, initial=0.0))
    if not len(forces):
        return np.zeros((0, 3))
    tails = tips - forces * (longest / strength.max())
    way = forces / np.maximum(strength, 1e-12)
    across = np.cross(way, np.where(np.abs(way[:, :1]) < 0.7, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    across *= 0.5 * FORCE_WIDTH * longest / np.linalg.norm(across, axis=1, keepdims=True)
    other = np.cross(way, across)
    ring = [tails + across, tails + other, tails - across, tails - other]
    sides = [(tips, ring[k], ring[(k + 1) % 4]) for k in range(4)]
    return np.array(sides).transpose(2, 0, 1, 3).reshape(-1, 3)


def _outline(solids: Solids, index: int) -> np.ndarray:
    """Return the twelve edges of a solid's oriented box as pairs of points, (24, 3); none for a plane."""
    if solids.kind[index] == kinds.PLANE:
        return np.zeros((0, 3))
    corners = CORNERS * solids.size[index]
    corners = corners @ solids.pose[index][:3, :3].T + solids.pose[index][:3, 3]
    pairs = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]
    return corners[np.array(pairs).ravel()]


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode()
