"""The uniform distribution over rotations: Haar measure, as unit quaternions (w, x, y, z)."""

import math

from derender.scene.distributions.base import DistributionType, distributions


def density(x, row):
    """Zero: the stock measure of rotations is Haar measure with total mass one.  Not a unit quaternion: -inf."""
    norm = math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3])
    return 0.0 if abs(norm - 1.0) < 1e-6 else -math.inf


def draw(rng, row):
    """Four normals on a line through the origin; the half with w >= 0 stands for both."""
    w, x, y, z = rng.standard_normal(), rng.standard_normal(), rng.standard_normal(), rng.standard_normal()
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0:
        norm = -norm
    return w / norm, x / norm, y / norm, z / norm


@distributions.register("uniform-rotation")
class UniformRotation(DistributionType):
    """Every orientation is as likely as another."""

    size = 4
    density = staticmethod(density)
    draw = staticmethod(draw)

    def support(self, parameters):
        return -1.0, 1.0
