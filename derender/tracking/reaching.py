"""What reaches into the image from its border and is no followed thing: a hand, an arm, a gripper.

It is nearer to the camera than all that is drawn. A pixel that it hides tells nothing of what lies there, so that what
it hides has not moved; a pixel that shows it is worth little to whatever else might be there.
"""

from typing import TYPE_CHECKING

import numpy as np

from derender.camera.windows import greatest, labelled, least

if TYPE_CHECKING:
    from derender.tracking.drawing import Drawing

# Nats of a pixel that shows what reaches in. A thing that comes to lie there gains no more, but where it was it loses
# up to drawing.LIMIT at each pixel that shows it still.
PRICE = 2.0
# Standard deviations, and metres besides, nearer than what is drawn: more than noise, and than a pose that is a little
# wrong; a finger is thicker.
OFF, AT_LEAST = 5.0, 0.008
SMALLEST = 60  # pixels: less is noise, or what enters
OUTLINE = 3  # pixels about it that may show it too: where it touches something it is hardly nearer
AT_BORDER = 3  # pixels at the border: more than noise and a thing's corner


def nearer(drawing: "Drawing", depth: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: where the present frame is clearly nearer than a depth (H, W) in metres."""
    observed = drawing.observed
    return (observed > 0) & (depth - observed > OFF * drawing.noise(observed) + AT_LEAST)


def reaching(drawing: "Drawing") -> np.ndarray:
    """Return (H, W) bool: what is nearer than all that is drawn, and than what the first frame shows before that, and
    hangs together with the image's border, and OUTLINE about it.

    Where nothing returns now, and something did in the first frame, it may be nearer than the sensor sees.
    """
    near = nearer(drawing, np.minimum(drawing.misfit.blurred, drawing.left_out))
    if int(near.sum()) < SMALLEST:
        return np.zeros(near.shape, bool)
    dark = (drawing.clean == 0) & drawing.returned
    marks, count = labelled(least(greatest(near | dark, 1), 1))
    sizes = np.bincount(marks.ravel(), weights=near.ravel(), minlength=count + 1)
    border = np.concatenate([marks[0], marks[-1], marks[:, 0], marks[:, -1]])
    large = (sizes >= SMALLEST) & (np.bincount(border, minlength=count + 1) >= AT_BORDER)
    large[0] = False
    return greatest(near & large[marks], OUTLINE)
