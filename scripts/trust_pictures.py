"""Draw the README's pictures of a good, an unsure and a wrong answer, of made scenes; print what derender says of each.

    python scripts/trust_pictures.py data/pictures/trust.png

Above is the depth image, below the best scene, red where the image does not fit it. The unsure image is small and
noisy; the wrong answer is that of a person who says that there are boxes only.
"""

import argparse
import sys
from dataclasses import replace

import numpy as np
from arguments import target
from PIL import Image
from readme_picture import GAP, depth_picture, scene_picture

import derender
from derender.cli import status_of
from derender.render.renderers.preview import default_colours
from derender.results.fit import fit_of
from derender.results.table import digits

SIZE = 256, 192
RED = np.array([215, 30, 30])
SMALL = derender.Camera.from_field_of_view(48, 36)
GOOD, UNSURE, WRONG = 11, 1, 11  # seeds of the scenes
NOISE = 0.015  # metres, of the unsure image


def answers():
    """Yield the name, the DepthImage and the Posterior of each example."""
    scene = derender.sample("grammar", seed=GOOD)
    image = scene.render(noise=True, seed=1)
    yield "good", image, derender.infer(image, seed=1)
    scene = derender.sample("tabletop", seed=UNSURE)
    scene = replace(scene, likelihood=scene.likelihood.with_values({"sigma": NOISE}))
    image = scene.render(SMALL, noise=True, seed=1)
    yield "unsure", image, derender.infer(image, seed=1)
    image = derender.sample("grammar", seed=WRONG).render(noise=True, seed=1)
    yield "wrong", image, derender.infer(image, shapes=["box"], seed=1)


def panel(image, posterior):
    """Return the picture of an answer."""
    solids = posterior.best.graph.solids()
    fit = fit_of(posterior.best.graph, image.camera, image.depth, posterior.meta.get("likelihood") or {})
    bad = np.isfinite(image.depth) & ~fit.explained
    found = scene_picture(solids, image.camera, default_colours(solids)).resize(SIZE)
    mask = np.asarray(Image.fromarray(bad).resize(SIZE))
    shown = np.where(mask[..., None], RED, np.asarray(found)).astype(np.uint8)
    seen = np.asarray(depth_picture(image.depth).resize(SIZE))
    return np.vstack([seen, np.full((GAP, SIZE[0], 3), 255, np.uint8), shown])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=target, help="PNG file to write")
    path = parser.parse_args().picture
    panels = []
    for name, image, posterior in answers():
        print(name, "trusted" if posterior.trusted else "not trusted")
        for structure in posterior.structures[:3]:
            print(f"  p {digits(structure.probability)}  {structure.words}")
        for doubt in posterior.doubts:
            print("  " + doubt)
        for found in posterior.objects:
            print("  ", found.name, (1000 * found.size).round(), "±", (1000 * found.size_error).round(1), "mm")
        panels += [panel(image, posterior), np.full((2 * SIZE[1] + GAP, GAP, 3), 255, np.uint8)]
    picture = Image.fromarray(np.hstack(panels[:-1]))
    picture.save(path, optimize=True)


if __name__ == "__main__":
    sys.exit(status_of(main))
