"""What is seen stands: draws that could not are ruled out, exactly."""

import numpy as np
import pytest

from derender.document import read_document
from derender.errors import DerenderError
from derender.physics.constraint import assume_stable, without_stands
from derender.results.posterior import Posterior, StructurePosterior

TEXT = """
derender: 1
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  red: {shape: {type: cube, side: 0.10}, parent: floor, contact: {type: face-to-face, x: 0, y: 0, theta: 0}}
  green: {shape: {type: cube, side: 0.10}, parent: red, contact: {type: face-to-face, theta: 0, u: 0.5, v: 0.5}}
"""


@pytest.fixture
def graph(tmp_path):
    (tmp_path / "scene.yaml").write_text(TEXT)
    return read_document(tmp_path / "scene.yaml").graph


def part(graph, places, weight=1.0):
    places = np.asarray(places, dtype=float)
    density = -places
    return StructurePosterior(graph, ("green.contact.u",), places[..., None], density, density, weight)


def test_the_posterior_given_that_it_stands_is_the_posterior_cut_off(graph):
    """The upper cube stands where its centre is over the lower one: u from a quarter to three quarters."""
    rng = np.random.default_rng(0)
    both = Posterior((part(graph, rng.random((2, 60)), 0.5), part(graph, 0.3 + 0.6 * rng.random((2, 60)), 0.5)))
    found, share = assume_stable(both)
    first, second = (p.values[..., 0] for p in found.parts)
    assert all(0.25 <= values.min() and values.max() <= 0.75 for values in (first, second))
    kept = [np.mean((p.values > 0.25) & (p.values < 0.75)) for p in both.parts]
    assert share == pytest.approx(np.mean(kept)) and found.meta["p_stands_before"] == share
    assert found.parts[0].weight == pytest.approx(kept[0] / sum(kept))
    # what is kept keeps its densities, and chains stay chains
    np.testing.assert_array_equal(found.parts[0].log_prior, -first)
    assert len(first) == 2 and first.shape[1] >= 20
    lopsided, _ = assume_stable(Posterior((part(graph, [[0.5] * 9 + [0.1], [0.1] * 9 + [0.5]]),)))
    assert lopsided.parts[0].values.shape == (1, 10, 1)


def test_a_structure_that_cannot_stand_is_gone_and_without_any_there_is_a_fault(graph):
    stands, falls = part(graph, [[0.5] * 4], 0.1), part(graph, [[0.1] * 4], 0.9)
    found, share = assume_stable(Posterior((stands, falls)))
    assert [p.weight for p in found.parts] == [1.0] and share == pytest.approx(0.1)
    with pytest.raises(DerenderError, match="stands"):
        assume_stable(Posterior((falls,)))


def test_a_scene_file_says_that_it_stands(tmp_path):
    text = TEXT.replace("u: 0.5", "u: {uniform: [0, 1]}") + "constraints: [stands: true]\n"
    (tmp_path / "prior.yaml").write_text(text)
    prior = read_document(tmp_path / "prior.yaml").prior
    rng = np.random.default_rng(0)
    places = np.array([prior.sample(rng).numbers()["green.contact.u"] for _ in range(60)])
    assert 0.25 < places.min() < 0.35 and 0.65 < places.max() < 0.75
    free, said = without_stands(prior)
    assert said and not free.constraints and not without_stands(free)[1]
    assert max(free.sample(rng).numbers()["green.contact.u"] for _ in range(40)) > 0.8
    (tmp_path / "wrong.yaml").write_text(text.replace("stands: true", "stands: false"))
    with pytest.raises(DerenderError, match=r"wrong\.yaml"):
        read_document(tmp_path / "wrong.yaml")
