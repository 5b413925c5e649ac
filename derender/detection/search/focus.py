"""How blurred the image is, told better by a first explanation of it than by its steps alone.

Beside a step of a metre a hundredth of a pixel more blur is worth several standard deviations of the noise: with the
blur a little wrong the search fills the silhouettes with thin solids.
"""

import numpy as np

from derender.detection.solids.image import blank, draw, taps_of
from derender.detection.solids.misfit import misfit_map

FIRST_LOOK = (0.0, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3)  # standard deviations in pixels
STEPS = (0.05, 0.025, 0.0125, 0.006, 0.003)  # of the closer look


def refocused(image, rows, price):
    """Return (image with the blur under which the solids explain it best, how much smaller its misfit is).

    price : nats that a blur must gain to be believed of an image that was taken for sharp.
    """
    clear, label, misfit = blank(image)
    draw(image, rows, -1, clear, label)

    def score(blur):
        return misfit_map(image._replace(taps=taps_of(blur)), clear, misfit), blur

    before = misfit_map(image, clear, misfit)
    best = min(score(blur) for blur in FIRST_LOOK)
    for step in STEPS:
        best = min(best, *(score(max(best[1] + way * step, 0.0)) for way in (-1, 1)))
    gained = before - best[0]
    if gained <= (price if image.taps.size == 1 else 0.0):
        return image, 0.0
    return image._replace(taps=np.ascontiguousarray(taps_of(best[1]))), gained
