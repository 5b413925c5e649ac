"""A quick search: the best scene alone, without draws."""

import numpy as np
import pytest

from derender.detection.solids.graph import names_of, structure_key
from derender.structures import graph_posterior
from derender.structures.alternatives import of_likeliest_shapes
from derender.structures.infer import infer_structure
from derender.structures.options import Options
from worlds.made_scenes import drawn_scene


@pytest.mark.parametrize("seed", [988402, 988407, 988412, 988426, 988441])
def test_a_quick_search_tells_cubes_from_boxes(seed):
    """Of 60 such images a search alone called cubes boxes in 13, four of these, and said P .88."""
    graph, image, _, eye = drawn_scene(seed, "tabletop")
    found = infer_structure(image, eye, Options(method="map", quick=True), np.random.default_rng(seed)).best_graph()
    there, true = (sorted(each.vertex(name).shape for name in each.names) for each in (found, graph))
    assert there == true


def test_shapes_are_weighed_against_the_one_that_is_taken_and_each_once(monkeypatch):
    """What a solid's last turn led to was among the others too, with the odds of an equal."""
    found = []

    def kept(*given):
        found.extend(of_likeliest_shapes(*given))
        return found

    monkeypatch.setattr(graph_posterior, "of_likeliest_shapes", kept)
    _, image, _, eye = drawn_scene(989355, "tabletop", (64, 48), 0.006)
    infer_structure(image, eye, Options(method="map", quick=True), np.random.default_rng(989355))
    names = names_of(found[0][0].state)
    told = [structure_key(trial.state, names) for trial, _ in found]
    assert len(told) > 1 and len(set(told)) == len(told) and max(odds for _, odds in found[1:]) <= 0.0
