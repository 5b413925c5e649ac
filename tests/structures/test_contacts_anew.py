"""Objects that move under others, or are put down anew, on real contacts: kept are their prior and its area elements.

The image says nothing here, at temperature 0, so that the posterior is the prior and every area is met.
"""

import math

import numpy as np
import pytest
from invariance import State, bound, verdict
from small_scenes import OPENING, SceneWorld

from derender.compilation.cache import njit
from derender.posterior.compiled import model
from derender.posterior.compiled.backend import CompiledBackend
from derender.posterior.compiled.evaluate import reattach
from derender.posterior.kernels.base import first_tuning, kernels, mixture
from derender.posterior.kernels.relocate import seen_place

# Two planks: where they lie across each other they touch at three times as many offsets as where they are parallel.
PLANKS = (
    OPENING
    + """
  low:
    shape: {type: box, length: 0.2, width: 0.02, height: 0.1}
    parent: floor
    contact: {type: face-to-face, theta: {uniform: [0, 180 deg]}, x: {normal: [0, 0.02]}, y: {normal: [0, 0.02]}}
  high:
    shape: {type: box, length: 0.2, width: 0.02, height: 0.1}
    parent: low
    contact: {type: face-to-face, theta: {uniform: [0, 180 deg]}, u: {uniform: [0, 1]}, v: {uniform: [0, 1]}}
likelihood: {type: gaussian, sigma: 1, background: 1.5}
"""
)


class Silent:
    """The scene without its image."""

    def __init__(self, world):
        self.space, self.prior = world.space, world.blank.log_prior

    def target(self, rng, values):
        return self

    def log_prior(self, values):
        return self.prior(values)

    def log_likelihood(self, values):
        return 0.0

    def summary(self):
        return np.ones(1)


@njit(nogil=True)
def without_area(vertices, extents, places, laws, values, numbers, pose, marks, scratch, n, put, there):
    """Takes (u, v) for metres."""
    found = reattach(vertices, extents, places, laws, values, numbers, pose, marks, scratch, n, put, there)
    return found if math.isnan(found) else 0.0


@njit(nogil=True)
def without_ratio(rng, places, periods, old, new):
    """Takes one place for as likely as another."""
    found = seen_place(rng, places, periods, old, new)
    return found if math.isnan(found) else 0.0


def verdict_of(name, replicates, until_caught=False):
    """Return the invariance test's verdict on steps of one kernel on the two planks."""
    world = SceneWorld(PLANKS)
    rng = np.random.default_rng(9)
    archive = np.array([world.space.sample(rng) for _ in range(15)])
    tuning = first_tuning(world.space, archive[0])._replace(temperature=0.0)
    tuning = tuning._replace(archive=archive, covariance=100.0 * tuning.covariance)
    parts = [part for part in mixture(world.space, [{name: {}}, {"resimulate": {}}]) if part.type == name]
    backend = CompiledBackend(world.blank, parts)

    def kernel(rng, state):
        stretch = backend.sweep(rng, state.values, tuning, 1, 1)
        return State(stretch.values[0], float(stretch.densities[0, 0]), 0.0), bool(stretch.counts[:, 1].sum())

    return verdict(Silent(world), lambda target: kernel, replicates, steps=6, until_caught=until_caught)


KEEPING = [name for name in kernels if kernels[name].keeps_children]


@pytest.mark.parametrize("name", KEEPING)
def test_contacts_made_anew_keep_the_prior(name):
    result = verdict_of(name, 3200)
    assert result.moved > 0.02
    assert result.worst < bound(len(result.z)), result


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name == "relocate" else ()) for name in KEEPING]
)
def test_a_lost_jacobian_is_caught(name, monkeypatch):
    monkeypatch.setattr(model, "reattach", without_area)
    result = verdict_of(name, 3200, until_caught=True)
    assert result.worst > bound(len(result.z)), result


@pytest.mark.slow
def test_a_lost_proposal_ratio_is_caught(monkeypatch):
    monkeypatch.setattr(type(kernels["relocate"]), "proposal", without_ratio, raising=False)
    result = verdict_of("relocate", 3200, until_caught=True)
    assert result.worst > bound(len(result.z)), result
