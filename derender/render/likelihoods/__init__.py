"""The library of likelihoods of depth images. A new one is a file with a class under `@likelihoods.register(name)`."""

from derender.render.likelihoods.pixelwise import Likelihood, drawn_image, likelihoods

# The built-in types register themselves when they are imported.
from derender.render.likelihoods import correlated, pixelwise  # isort: skip

__all__ = ["Likelihood", "correlated", "drawn_image", "likelihoods", "pixelwise"]
