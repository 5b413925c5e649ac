"""What a second process compiles ahead: that it still runs, and compiles what the command itself would."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numba import typeof

from derender.compilation import cache
from derender.document import read_prior_document
from derender.posterior.compiled import backend
from derender.posterior.compiled import model as arrays
from derender.posterior.kernels import mixture
from derender.posterior.sampler import MixtureSampler
from derender.posterior.target import default_parts
from derender.structures.given import targets
from derender.structures.precompile import PARTS, steps_of_chains


@pytest.mark.parametrize("name", PARTS)
def test_what_is_compiled_ahead_still_runs(name):
    done = subprocess.run([sys.executable, "-m", "derender.structures.precompile", name], stdin=_open_end(),
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr


def _open_end() -> int:
    """Return the reading end of a pipe that stays open: the process leaves when its starter has gone."""
    reading, _writing = os.pipe()
    return reading


def test_the_steps_of_chains_are_compiled_for_the_types_that_a_chain_has(monkeypatch):
    """Else both processes would compile them, each for itself."""
    asked, used = {}, {}

    def noted(kernel, notes, call):
        def note(*given):
            notes[kernel] = tuple(map(typeof, given))
            return call(*given)

        return note

    with monkeypatch.context() as patched:
        patched.setattr(cache, "address_of", lambda kernel, *given: noted(kernel, asked, lambda *_: 0)(*given))
        steps_of_chains()
    monkeypatch.setattr(backend, "sweep", noted(backend.sweep, used, backend.sweep))
    monkeypatch.setattr(arrays, "stand_all", noted(arrays.stand_all, used, arrays.stand_all))
    document = read_prior_document("figure-4")
    target = targets(document, np.full(document.camera.shape, 0.9), document.camera, 0)[0][0]
    sampler = MixtureSampler(target, mixture(target.space, default_parts()), particles=2)
    sampler.advance(np.random.default_rng(0), sampler.start(np.random.default_rng(0)), 1)
    assert asked == used and len(used) == 2
