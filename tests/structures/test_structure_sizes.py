"""Sizes of solids as a prior file states them: tabulated, integrated, drawn."""

import numpy as np
import pytest
from scipy.stats import kstest
from test_graph_posterior import camera, floor_pose, observe, row

from derender.detection.solids.beliefs import CUBE, Rules, bare_image, box_log_density, log_density_at, sizes_of
from derender.detection.solids.state import FLOOR, State
from derender.document import read_prior_document
from derender.scene.distributions import distributions
from derender.scene.priors.objects import ShapePrior
from derender.scene.solids import BOX, CYLINDER, SPHERE
from derender.structures.case import settings_of
from derender.structures.draws.chart import SIZE, SLOTS, make_chart
from derender.structures.draws.metropolis import engine_of, run, walker_at
from derender.structures.draws.steps import own_members, single_steps
from derender.structures.options import Options

UPRIGHT = 0


class Shapes:
    """What sizes_of reads of a prior."""

    def __init__(self, **shapes):
        self.shapes = shapes


def uniform(low, high):
    return distributions["uniform"](low, high)


PRIOR = Shapes(
    flat=ShapePrior(
        "box", {"length": uniform(0.10, 0.14), "width": uniform(0.04, 0.06), "height": uniform(0.03, 0.05)}
    ),
    die=ShapePrior("cube", {"side": distributions["log-normal"](0.06, 0.3)}, weight=3.0),
    ball=ShapePrior("sphere", {"radius": distributions["normal"](0.03, 0.002)}),
    can=ShapePrior("cylinder", {"radius": 0.033, "height": uniform(0.08, 0.12)}),
)


def test_densities_are_those_of_the_file_and_integrate_to_one():
    table = sizes_of(PRIOR)
    grid = np.linspace(0.001, 0.3, 60_001)
    for kind, axis in ((BOX, 0), (BOX, 2), (CUBE, 1), (SPHERE, 0), (CYLINDER, 0), (CYLINDER, 2)):
        density = np.exp([log_density_at(table[kind, axis], x) for x in grid])
        assert density.sum() * (grid[1] - grid[0]) == pytest.approx(1.0, abs=1e-3)
    assert log_density_at(table[SPHERE, 0], 0.061) == pytest.approx(
        distributions["normal"](0.03, 0.002).log_density(0.0305) - np.log(2.0), abs=0.01
    )
    assert log_density_at(table[CYLINDER, 0], 0.066) > log_density_at(table[CYLINDER, 0], 0.069) + 10.0


def test_a_box_has_its_sizes_under_any_name_but_its_height_upright():
    table = sizes_of(PRIOR)
    given = sum(log_density_at(table[BOX, axis], size) for axis, size in enumerate((0.12, 0.05, 0.04)))
    assert given == pytest.approx(-np.log(0.04 * 0.02 * 0.02), abs=0.1)  # the soft ends hold a little
    sizes = np.array([0.12, 0.05, 0.04])
    assert box_log_density(table[BOX], sizes, True) == pytest.approx(given - np.log(2.0))
    assert box_log_density(table[BOX], sizes[[1, 0, 2]], True) == pytest.approx(given - np.log(2.0))
    assert box_log_density(table[BOX], sizes[[2, 1, 0]], True) < given - 100.0
    # .05 is a width and at the end of heights, .04 a height and at the end of widths: two ways
    assert box_log_density(table[BOX], sizes[[2, 1, 0]], False) == pytest.approx(given - np.log(6.0 / 2.0))


def test_the_built_in_prior_is_read():
    beliefs = settings_of(Options(prior=read_prior_document("tabletop").prior)).beliefs
    table = beliefs.sizes
    assert beliefs.kinds[CUBE] == beliefs.kinds[BOX] == pytest.approx(np.log(0.5))
    assert beliefs.on_floor[2] == pytest.approx(np.log(0.35 * 2.0 / 0.16**2), abs=0.01)
    assert beliefs.on_top[BOX, :2] == pytest.approx(np.log([0.8, 0.2]))
    assert log_density_at(table[BOX, 1], 0.1) == pytest.approx(-np.log(0.1), abs=0.01)
    assert log_density_at(table[CUBE, 0], 0.13) < -100.0  # cubes end at 12 cm


def test_walk_draws_sizes_from_the_file():
    state = State().add(row(BOX, 0.4, 0.0, 0.0, 0.0, (0.12, 0.05, 0.04)), UPRIGHT, False, FLOOR, 0.0)
    chart, values = make_chart(state, floor_pose(), Rules(0.0015, beliefs=bare_image()._replace(sizes=sizes_of(PRIOR))))
    sensor, _, _ = observe(np.random.default_rng(0), state, {"sigma": 0.01}, camera(16, 12))
    proposals = single_steps(chart, own_members(chart, 0))
    proposals.scale[:] = 0.01
    walker = walker_at(engine_of(chart, sensor), chart, values)
    draws = run(np.random.default_rng(3), walker, proposals, 0.0, 0.0, 1000, 80)
    length, height = (draws.values[::2, int(chart.slots[0, SIZE + axis])] for axis in (0, 2))
    # soft ends of 0.3 mm beside a range of 20 to 40 mm: two per cent
    assert kstest(length, "uniform", (0.10, 0.04)).statistic < 0.1
    assert kstest(height, "uniform", (0.03, 0.02)).statistic < 0.1
    assert kstest(height, "uniform", (0.10, 0.04)).statistic > 0.9  # a broken twin: the length's
    assert chart.slots.shape == (1, SLOTS)
