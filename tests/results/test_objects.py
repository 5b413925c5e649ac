"""Ranges of sizes: against quantiles of draws that are known."""

from dataclasses import replace

import numpy as np
import pytest
from on_floor import cube, face, on_floor

from derender.interface import posterior as interface
from derender.report.scene_json import scene_json, size_intervals, weighted_quantile
from derender.report.tree_text import told_structures
from derender.results.posterior import Posterior, StructurePosterior
from derender.scene.graph import Vertex

TIN = Vertex("tin", "cylinder", {"radius": 0.05, "height": 0.1}, "floor", face())
GRAPH = on_floor(TIN, cube("die", side=0.02))


def part(radius, weight=1.0):
    values = np.stack([radius, np.zeros_like(radius)], axis=-1).reshape(2, -1, 2)
    density = np.zeros(values.shape[:2])
    return StructurePosterior(GRAPH, ("tin.radius", "tin.contact.x"), values, density, density, weight)


def test_a_range_holds_ninety_percent_along_the_own_axes():
    radius = np.random.default_rng(0).normal(0.05, 0.001, 400)
    told = size_intervals(Posterior((part(radius),)))
    expected = 2 * np.quantile(radius, [0.05, 0.95])
    assert told["floor"] is None
    np.testing.assert_allclose(told["tin"], [expected, expected, [0.1, 0.1]], atol=2e-5)
    assert told["die"] == [[0.02, 0.02]] * 3


def test_a_range_that_is_not_about_the_best_is_told_and_drawn_as_it_is():
    """A bar of half its length to both sides of the best stood for it, down to sizes that no draw has."""
    import matplotlib.pyplot as plt

    radius = np.concatenate([[0.05], np.random.default_rng(0).uniform(0.05, 0.1, 399)])
    lopsided = part(radius)
    lopsided.log_density.flat[0] = 1.0  # the best is the least
    found = interface.Posterior.of(Posterior((lopsided,)), None)
    low, high = found.objects["tin"].size_interval[0]
    assert found.objects["tin"].size[0] == pytest.approx(0.1) and 0.1 < low < 0.12 < 0.19 < high
    assert f"10.0 ({100 * low:.1f} to {100 * high:.1f})" in repr(found.objects)
    told = {name: ends[0] for name, ends in size_intervals(found).items() if ends}
    assert told["tin"] == [low, high]
    (bars,) = found.plot_sizes().containers[0][2]
    assert max(end[1] for line in bars.get_segments() for end in line) == pytest.approx(1000 * high)
    plt.close("all")


def test_of_one_draw_no_range_is_told():
    """`--quick` told ranges of no width at all: sizes known exactly, which they are not."""
    best = Posterior((part(np.full(40, 0.05)).best_only(),))
    assert best.best_part.log_density.size == 1
    told = size_intervals(best)
    assert told["tin"] is None and told["die"] == [[0.02, 0.02]] * 3  # nothing is unknown of how big the die is
    entry = scene_json(best.best_graph(), best)["objects"][1]
    assert entry["size_interval"] is None and entry["size"] == pytest.approx([0.1, 0.1, 0.1])
    found = interface.Posterior.of(best, None).objects
    assert np.isnan(found["tin"].size_error).all() and not found["die"].size_error.any()
    assert "10.0 × 10.0 × 10.0" in repr(found) and "nan" not in repr(found) and "nan" not in found._repr_html_()


def test_a_weight_lies_where_its_error_says():
    one = replace(part(np.full(4, 0.05)), weight=0.85, weight_error=0.1)
    assert one.interval == pytest.approx((0.6855, 1.0), abs=1e-3)
    assert replace(one, weight_interval=(0.7, 0.9)).interval == (0.7, 0.9)


def test_what_is_left_for_structures_that_were_not_found_is_told():
    """A lone structure of P .85 left its reader to wonder what the other .15 are."""
    one, other = (replace(part(np.full(4, 0.05)), weight=weight) for weight in (0.85, 0.03))
    told = told_structures(Posterior((one, other)))
    assert [(each.text, each.words) for each in told[1:]] == [(".03", "the same"), (".12", "none of these")]
    assert told[-1].probability == pytest.approx(0.12)
    assert len(told_structures(Posterior((replace(one, weight=0.995),)))) == 1  # none of that in two digits


def test_structures_count_with_their_weights():
    ranges = [size_intervals(Posterior((part(np.full(200, 0.05), w), part(np.full(40, 0.06), 1 - w))))["tin"][0]
              for w in (0.99, 0.9, 0.5, 0.02)]  # fmt: skip
    np.testing.assert_allclose(ranges[0], [0.1, 0.1])
    np.testing.assert_allclose(ranges[1], [0.1, 0.12], atol=2e-3)
    np.testing.assert_allclose(ranges[2], [0.1, 0.12])
    np.testing.assert_allclose(ranges[3], [0.12, 0.12])


def test_a_structure_without_the_object_says_nothing_of_its_size():
    bare = replace(part(np.full(4, 0.05), 0.4), graph=GRAPH.remove("tin"), addresses=(), values=np.zeros((2, 2, 0)))
    told = size_intervals(Posterior((part(np.linspace(0.04, 0.06, 100), 0.6), bare)))
    np.testing.assert_allclose(told["tin"][0], 2 * np.quantile(np.linspace(0.04, 0.06, 100), [0.05, 0.95]), atol=2e-4)


def test_weighted_quantiles_are_those_of_repeated_values():
    rng = np.random.default_rng(1)
    values, counts = rng.random(30), rng.integers(1, 30, 30)
    for share in (0.05, 0.5, 0.95):
        repeated = np.quantile(np.repeat(values, counts), share, method="hazen")
        gap = np.diff(np.sort(values)).max()
        assert weighted_quantile(values, counts.astype(float), share) == pytest.approx(repeated, abs=gap)
