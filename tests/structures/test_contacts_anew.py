"""Objects that move under others, or are put down anew, on real contacts: kept are their prior and its area elements.

The image says nothing here, so that the posterior is the prior and every area is met. The compiled steps are these
(`test_compiled.py`).
"""

import numpy as np
import pytest
from invariance import bound, steps_of, verdict
from small_scenes import OPENING, SceneWorld

from derender.posterior.compiled.backend import InterpretedBackend
from derender.posterior.kernels.base import first_tuning, mixture
from derender.posterior.target import SceneTarget

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
    """An image that says nothing."""

    values: dict = {}

    def log_likelihood(self, graph, parameters):
        return 0.0


class WithoutArea(SceneTarget):
    """Takes (u, v) for metres."""

    def _reattached(self, *arguments):
        found = super()._reattached(*arguments)
        return found and (found[0], 0.0)


class SilentWorld(SceneWorld):
    """The scene without its image."""

    def target(self, rng, values):
        target = SceneTarget(self.document.prior, self.template, Silent())
        target.summary = lambda: np.ones(1)
        return target


@pytest.mark.slow
@pytest.mark.parametrize("twin", [None, WithoutArea])
@pytest.mark.parametrize(
    "name, replicates", [("relocate", 1200), ("turn", 3200), ("slide", 3200), ("relocate-stack", 3200)]
)
def test_contacts_made_anew_keep_the_prior(name, replicates, twin):
    world = SilentWorld(PLANKS)
    rng = np.random.default_rng(9)
    archive = np.array([world.space.sample(rng) for _ in range(15)])
    tuning = first_tuning(world.space, archive[0])
    tuning = tuning._replace(archive=archive, covariance=100.0 * tuning.covariance)
    parts = [part for part in mixture(world.space, [{name: {}}, {"resimulate": {}}]) if part.type == name]
    backend = InterpretedBackend(world.target(rng, archive[0]), parts)
    backend.program(tuning)

    def make(target):
        target.__class__ = twin or SceneTarget
        backend.target = target
        return steps_of(backend, tuning)

    result = verdict(world, make, replicates, steps=6, until_caught=bool(twin))
    assert result.moved > 0.02
    assert (result.worst > bound(len(result.z))) == bool(twin), result
