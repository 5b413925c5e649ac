"""Plots with matplotlib; each takes axes of one's own, or makes new ones, and returns them."""

from typing import Any

import numpy as np

from derender.camera.depth_file import DepthImage
from derender.errors import DerenderError
from derender.interface.posterior import SIDES, Posterior

MOST_BARS = 12  # structures in one plot


def plot_depth(seen: Any, ax=None):
    """Draw a depth image: of a DepthImage, a Scene, a Posterior (the observed one) or an array (H, W) in metres."""
    if isinstance(seen, Posterior):
        if seen.image is None:
            raise DerenderError("the posterior does not have its image", remedy="load the folder, not posterior.npz")
        seen = seen.image
    depth = seen.depth if isinstance(seen, DepthImage) else seen.render().depth if hasattr(seen, "render") else seen
    axes = _axes(ax)
    shown = axes.imshow(np.ma.masked_invalid(np.asarray(depth, float)), cmap="viridis_r", interpolation="nearest")
    axes.figure.colorbar(shown, ax=axes, label="depth, m")
    axes.set_xticks([])
    axes.set_yticks([])
    return axes


def plot_sizes(posterior: Posterior, ax=None):
    """Draw the length, width and height of each object with their 90 % ranges, in millimetres."""
    axes, objects = _axes(ax), posterior.objects
    places = np.arange(len(objects))
    for number, side in enumerate(SIDES):
        sizes = [1000 * found.size[number] for found in objects]
        errors = [1000 * found.size_error[number] for found in objects]
        axes.errorbar(places + 0.2 * (number - 1), sizes, errors, fmt="o", capsize=3, label=side)
    axes.set_xticks(places, [found.name for found in objects], rotation=30, ha="right")
    axes.set_ylabel("mm, 90 % range")
    axes.set_ylim(bottom=0)
    axes.legend()
    return axes


def plot_structures(posterior: Posterior, ax=None):
    """Draw the probabilities of the structures found, the most probable on top."""
    from derender.report.structure_words import told_structures

    axes = _axes(ax)
    told = told_structures(posterior)[:MOST_BARS][::-1]
    axes.barh([words for _, words in told], [weight for weight, _ in told])
    axes.set_xlim(0, 1)
    axes.set_xlabel("probability")
    return axes


def _axes(ax):
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots()[1]
