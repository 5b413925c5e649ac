"""What reaches into the image from its border and is no followed thing: a hand, an arm, a gripper.

It is nearer to the camera than all that is drawn. A pixel that it hides tells nothing of what lies there, so that what
it hides has not moved; a pixel that shows it is worth little to whatever else might be there.
"""

from typing import TYPE_CHECKING

import numpy as np

from derender.camera.windows import greatest, labelled, least
from derender.render.likelihoods.pixelwise import noise_at

if TYPE_CHECKING:
    from derender.tracking.drawing import Drawing

# Nats of a pixel that shows what reaches in. A thing that comes to lie there gains no more, but where it was it loses
# up to drawing.LIMIT at each pixel that shows it still.
PRICE = 2.0
PRICE_STILL = 0.0  # nats, of one that has shown it in the frame before, too: no thing is there now
# Standard deviations, and metres besides, nearer than what is drawn: more than noise, and than a pose that is a little
# wrong, at contacts and edges; a finger is thicker.
OFF, AT_LEAST = 5.0, 0.008
SMALLEST = 60  # pixels: less is noise, or what enters
OUTLINE = 2  # pixels about it that may show it too: where it touches something it is hardly nearer
AT_BORDER = 3  # pixels at the border: more than noise and a thing's corner


def nearer(drawing: "Drawing", depth: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: where the present frame is clearly nearer than a depth (H, W). spread : (H, W), both in
    metres."""
    return (drawing.observed > 0) & (depth - drawing.observed > OFF * spread + AT_LEAST)


def bare_noise(drawing: "Drawing") -> np.ndarray:
    """Return the standard deviation (H, W) of the present frame's noise in metres, without what `Drawing.spread` has at
    steps in depth besides: a finger is little else."""
    return noise_at(drawing.observed, {"sigma": drawing.start.sigma, "sigma_growth": drawing.start.growth})


def patches(near: np.ndarray, bridge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ((H, W) int, the number of the patch that each pixel is in, 0 for none; how many `near` pixels each has).

    near : (H, W) bool. bridge : (H, W) bool, pixels that may join them. Gaps of two pixels are bridged, too.
    """
    marks, count = labelled(least(greatest(near | bridge, 1), 1))
    return marks, np.bincount(marks.ravel(), weights=near.ravel(), minlength=count + 1)


def at_border(marks: np.ndarray, count: int) -> np.ndarray:
    """Return how many pixels at the border each of so many patches (H, W) has: (count,)."""
    border = np.concatenate([marks[0], marks[-1], marks[:, 0], marks[:, -1]])
    return np.bincount(border, minlength=count)


def never_seen(depth: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: where a first frame (H, W), metres, returns nothing from the image's border on."""
    void = ~(depth > 0)
    marks, sizes = patches(void, void)
    return void & (at_border(marks, len(sizes)) >= AT_BORDER)[marks] & (marks > 0)


def reaching(drawing: "Drawing", outline: int = OUTLINE) -> np.ndarray:
    """Return (H, W) bool: what is nearer than all that is drawn, and than what the first frame shows before that, and
    hangs together with the image's border, and so many pixels about it.

    Where nothing returns now, and something did in the first frame, it may be nearer than the sensor sees; where
    nothing did from the border on, as the floor is too far there, it comes from beyond that.
    """
    near = nearer(drawing, np.minimum(drawing.misfit.blurred, drawing.left_out), bare_noise(drawing))
    if int(near.sum()) < SMALLEST:
        return np.zeros(near.shape, bool)
    dark = (drawing.clean == 0) & (drawing.returned | drawing.beyond)
    marks, sizes = patches(near, dark)
    large = (sizes >= SMALLEST) & (at_border(marks, len(sizes)) >= AT_BORDER)
    large[0] = False
    return greatest(near & large[marks], outline) if outline else near & large[marks]
