"""Draw the picture of the README: a depth image, the scene that derender found in it, and a view from elsewhere.

python scripts/readme_picture.py IMAGE CAMERA RESULT data/pictures/derender.png

RESULT is a folder written by `infer`.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from arguments import target
from PIL import Image

from derender.camera.depth_file import read_depth
from derender.camera.intrinsics import Camera
from derender.cli import status_of
from derender.document import read_document
from derender.render.renderers import find_renderer
from derender.render.renderers.preview import default_colours, draw_preview
from derender.scene.pose import from_rotation_vector, rotation_x, translation
from derender.scene.solids import PLANE

WIDTH, HEIGHT, GAP = 480, 360, 8


def depth_picture(depth: np.ndarray) -> Image.Image:
    """Return the depth image in colour, near bright; black where nothing returned."""
    from matplotlib import colormaps

    low, high = np.nanpercentile(1 / depth, [1, 99])
    share = np.clip((1 / depth - low) / (high - low), 0, 1)
    colour = (colormaps["magma"](0.1 + 0.85 * np.nan_to_num(share))[..., :3] * 255).astype(np.uint8)
    colour[np.isnan(depth)] = 0
    return Image.fromarray(colour).resize((WIDTH, HEIGHT), Image.Resampling.NEAREST)


def scene_picture(solids, camera: Camera, colours: np.ndarray) -> Image.Image:
    """Return the shaded scene as the camera sees it; colours : (N, 3) uint8."""
    factor = 2 * WIDTH // camera.width + 1
    large = Camera(
        camera.fx * factor,
        camera.fy * factor,
        camera.cx * factor + (factor - 1) / 2,
        camera.cy * factor + (factor - 1) / 2,
        camera.width * factor,
        camera.height * factor,
    )
    picture = draw_preview(find_renderer("raycast").render_depth, solids, large, colours)
    return Image.fromarray(picture).resize((WIDTH, HEIGHT), Image.Resampling.LANCZOS)


def seen_from_elsewhere(solids, turn: float, lift: float):
    """Return the solids as a camera sees them that went around them by `turn` and up by `lift` radians."""
    middle = solids.pose[solids.kind != PLANE, :3, 3].mean(axis=0)
    up = solids.pose[solids.kind == PLANE][0, :3, 2]
    moved = translation(*middle) @ rotation_x(lift) @ from_rotation_vector(turn * up) @ translation(*-middle)
    return solids._replace(pose=moved @ solids.pose)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("image", "camera", "result"):
        parser.add_argument(name)
    parser.add_argument("picture", type=target, help="PNG file to write")
    given = parser.parse_args()
    seen = read_depth(given.image, given.camera)
    solids = read_document(Path(given.result) / "scene.yaml").graph.solids()
    colours = default_colours(solids)
    pictures = [
        depth_picture(seen.depth),
        scene_picture(solids, seen.camera, colours),
        scene_picture(seen_from_elsewhere(solids, -0.7, 0.35), seen.camera, colours),
    ]
    whole = Image.new("RGB", (3 * WIDTH + 2 * GAP, HEIGHT), "white")
    for place, picture in enumerate(pictures):
        whole.paste(picture, (place * (WIDTH + GAP), 0))
    whole.save(given.picture, optimize=True)


if __name__ == "__main__":
    sys.exit(status_of(main))
