"""Worlds of a few numbers in which prior, data and posterior are cheap: where kernels are proved."""

import math

import numpy as np

from derender.posterior.space import Block, Space, Unknown
from derender.scene.distributions import distributions


class World:
    """Unknowns with normal observations of some functions of them."""

    noise = 0.5

    def __init__(self, unknowns, blocks, model):
        self.space = Space(unknowns, blocks)
        self.model = model

    def target(self, rng, values):
        clean = self.model(values)
        return Target(self, clean + self.noise * rng.standard_normal(len(clean)))


class Target:
    def __init__(self, world, data):
        self.world, self.space, self.data = world, world.space, data

    def log_prior(self, values):
        return self.space.log_prior(values)

    def log_likelihood(self, values):
        residual = (self.data - self.world.model(values)) / self.world.noise
        return -0.5 * float(residual @ residual)

    def summary(self):
        return self.data


def _stretch(x):
    return math.exp(1.2 * x)


def angle_and_child():
    """An angle, a place x, and a child's u whose place in the world depends on x."""
    unknowns = [
        Unknown("a.contact.theta", distributions["von-mises"](0.3, 1.0, math.pi), math.pi),
        Unknown("a.contact.x", distributions["normal"](0.0, 1.0)),
        Unknown("b.contact.u", distributions["uniform"](-1.0, 1.5)),
    ]
    blocks = [Block("a.contact", (0, 1)), Block("b.contact", (2,))]

    def model(values):
        theta, x, u = values
        return np.array([math.sin(2 * theta) + x, math.cos(2 * theta), x + _stretch(x) * u])

    return World(unknowns, blocks, model)


def box_with_sides():
    """A box's angle, length and width, seen through its second moments."""
    unknowns = [
        Unknown("a.contact.theta", distributions["uniform"](0.0, math.pi), math.pi),
        Unknown("a.length", distributions["uniform"](0.5, 2.0)),
        Unknown("a.width", distributions["gamma"](4.0, 0.25)),
    ]
    blocks = [Block("a.contact", (0,)), Block("a.shape", (1, 2))]

    def model(values):
        theta, length, width = values
        c, s = math.cos(theta), math.sin(theta)
        return np.array([
            length**2 * c * c + width**2 * s * s,
            (length**2 - width**2) * c * s,
            length * width,
        ])  # fmt: skip

    return World(unknowns, blocks, model)


def floating():
    """A rotation and a length; the rotation is seen through where it takes two axes."""
    unknowns = [
        Unknown("a.contact.quat_wxyz", distributions["uniform-rotation"]()),
        Unknown("a.contact.z", distributions["log-normal"](1.0, 0.5)),
    ]
    blocks = [Block("a.contact", (0, 1))]

    def model(values):
        w, x, y, z, length = values
        return np.array([
            length * (1 - 2 * (y * y + z * z)),
            length * 2 * (x * y + w * z),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ])  # fmt: skip

    return World(unknowns, blocks, model)


WORLDS = {"angle": angle_and_child, "box": box_with_sides, "floating": floating}
