"""Langevin: a step along the gradient of the log posterior, corrected (MALA), preconditioned by warm-up."""

import numpy as np

from derender.posterior.kernels.base import KernelType, kernels
from derender.posterior.kernels.informed import Informed


class Langevin(Informed):
    """Propose tangent t = s^2 / 2 C g(old) + s L z with C = L L^T, g the gradient of the log posterior in tangents.

    Normal with that mean m(old) and covariance s^2 C, so
    log q(t | place) = -|L^-1 (t - m(place))|^2 / (2 s^2); the log ratio is that of `Informed`.
    """

    name = "langevin all"

    def __init__(self, target, block, derivative, factor, scale, temperature=1.0):
        super().__init__(target, block, derivative, scale, temperature)
        self.factor = factor

    def known(self, values):
        gradient, _ = self.derivative.at(values, self.temperature)
        return 0.5 * self.scale**2 * (self.factor @ (self.factor.T @ gradient))

    def tangent(self, normal, known):
        return known + self.scale * (self.factor @ normal)

    def log_proposal(self, tangent, known):
        white = np.linalg.solve(self.factor, tangent - known)
        return -0.5 * float(white @ white) / self.scale**2


@kernels.register("langevin")
class LangevinType(KernelType):
    """Step along the gradient of the log posterior in all unknowns (MALA)."""

    options = {"scale": 1.0}
    per_block = False
    adapts = True
    acceptance = 0.57

    def applies(self, space, block):
        # A rotation's tangent has a density per volume that is not that per Haar measure: lines and circles only.
        return bool(block.unknowns) and all(unknown.distribution.size == 1 for unknown in space.unknowns)

    def build(self, target, block, tuning, options):
        size = len(tuning.covariance)
        scale = options["scale"] * tuning.scale.get("langevin all", 1.0) * 1.2 / size ** (1 / 6)
        factor = np.linalg.cholesky(tuning.covariance)
        return Langevin(target, block, target.derivative(), factor, scale, tuning.temperature)
