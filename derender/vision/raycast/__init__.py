"""The compiled renderer and likelihood: no OpenGL, no Python in the inner loop."""

from derender.vision.raycast.compilation import forget_stale_kernels

forget_stale_kernels()
