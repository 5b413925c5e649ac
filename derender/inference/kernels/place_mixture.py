"""A density over places of one object, fitted to those that warm-up saw: it follows every mode, however narrow."""

import functools
from typing import NamedTuple

import numpy as np

DEGREES = 5  # of freedom of each component: heavier tails than an image's posterior
NEIGHBOURS = 16  # among the other places; a mode that holds as many has components of its own shape
LEAST = 1e-5  # radians and metres, a floor of the spread
UNSEEN = (0.2, 0.02, 0.02)  # spread about the places where there are few


class PlaceMixture(NamedTuple):
    """Multivariate t distributions with 5 degrees of freedom and equal weights, one about each of K places.

    A place is (angle, then D - 1 lengths); the angle lives on a circle.

    Attributes
    ----------
    centres : (K, D) float64.
    factors : (K, D, D) float64, lower triangular. inverses : theirs.
    period : of the angle.
    """

    centres: np.ndarray
    factors: np.ndarray
    inverses: np.ndarray
    period: float

    def density(self, place: np.ndarray) -> float:
        """Return q(place) up to a constant; steps of more than half a period are never proposed."""
        steps = place - self.centres
        steps[:, 0] = (steps[:, 0] + 0.5 * self.period) % self.period - 0.5 * self.period
        white = np.einsum("kij,kj->ki", self.inverses, steps)
        determinants = np.prod(np.diagonal(self.inverses, axis1=1, axis2=2), axis=1)
        powers = (1.0 + np.sum(white * white, axis=1) / DEGREES) ** (-0.5 * (DEGREES + len(place)))
        return float(np.sum(determinants * powers))

    def flat(self) -> np.ndarray:
        """Return (K * 16,) float64 of D = 3: centre, lower triangle, that of the inverse, the inverse's determinant."""
        below = np.tril_indices(3)
        determinants = np.prod(np.diagonal(self.inverses, axis1=1, axis2=2), axis=1)
        rows = [self.centres, self.factors[:, *below], self.inverses[:, *below], determinants[:, None]]
        return np.concatenate(rows, axis=1).ravel()


def fitted(centres: np.ndarray, period: float) -> PlaceMixture:
    """Return the mixture about (K, D) places; each component has the covariance of its nearest neighbours.

    So each is as wide and as slanted as the posterior is there. Near is meant in units of the components' harmonic mean
    covariance, found with a first round in units of all places'.
    """
    return _fitted(np.ascontiguousarray(centres).tobytes(), centres.shape[1], period)


@functools.lru_cache(128)
def _fitted(content: bytes, size: int, period: float) -> PlaceMixture:
    centres = np.frombuffer(content).reshape(-1, size)
    steps = centres[None] - centres[:, None]
    steps[..., 0] = (steps[..., 0] + 0.5 * period) % period - 0.5 * period
    near = min(NEIGHBOURS, len(centres) - 1)
    if near <= size:
        covariances = np.tile(np.diag(np.square(UNSEEN[:size])), (len(centres), 1, 1))
    else:
        floor = LEAST**2 * np.eye(size)
        metric = np.einsum("kni,knj->ij", steps, steps) / (2.0 * len(centres) ** 2) + floor
        for _ in range(2):
            white = np.linalg.solve(np.linalg.cholesky(metric), steps.reshape(-1, size).T)
            distances = np.sum(white * white, axis=0).reshape(len(centres), -1)
            nearest = np.argpartition(distances, near, axis=1)[:, : near + 1]
            close = np.take_along_axis(steps, nearest[..., None], axis=1)
            covariances = np.einsum("kni,knj->kij", close, close) / near + floor
            metric = np.linalg.inv(np.linalg.inv(covariances).mean(axis=0))
    factors = np.linalg.cholesky(covariances)
    return PlaceMixture(centres, factors, np.linalg.inv(factors), period)
