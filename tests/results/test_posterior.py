"""posterior.npz: what is saved is what is loaded, to the bit; NetCDF is what ArviZ reads."""

import math
import signal
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from small_scenes import LOOKED_AT, TOWER, SceneWorld

from derender.errors import DerenderError
from derender.results.posterior import Posterior, StructurePosterior, load
from derender.results.predictive import write_netcdf
from derender.results.trust import chain_doubts
from derender.sampling.diagnostics import unwrap


def part(text=TOWER, weight=1.0, seed=0):
    world = SceneWorld(text)
    rng = np.random.default_rng(seed)
    values = np.array([[world.space.sample(rng) for _ in range(5)] for _ in range(2)])
    poses = np.array([[world.blank.root_pose(v) for v in chain] for chain in values])
    free_root = any(a.startswith("root.") for a in world.space.addresses)
    return world, StructurePosterior(
        world.template,
        world.space.addresses,
        values,
        rng.standard_normal((2, 5)),
        rng.standard_normal((2, 5)),
        weight,
        world.space.periods,
        poses if free_root else None,
        {"acceptance": {"drift": 0.25}},
    )


@pytest.mark.parametrize("text", [TOWER, LOOKED_AT], ids=["tower", "looked-at"])
def test_saved_is_loaded(tmp_path, text):
    world, one = part(text)
    posterior = Posterior((one,), 3, "derender infer x", meta={"noise": 1.5})
    posterior.save(tmp_path / "posterior.npz")
    again = load(tmp_path)
    assert (again.seed, again.command, again.version) == (3, "derender infer x", posterior.version)
    assert again.meta == {"noise": 1.5} and again.parts[0].extras == {"acceptance": {"drift": 0.25}}
    np.testing.assert_array_equal(again.parts[0].values, one.values)
    np.testing.assert_array_equal(again.parts[0].log_density, one.log_density)
    assert again.parts[0].addresses == one.addresses and again.parts[0].periods == one.periods
    assert again.best_graph() == posterior.best_graph()
    drawn = one.graph_at(1, 3)
    expected = world.blank.graph(one.values[1, 3])
    for name, pose in expected.poses().items():
        np.testing.assert_allclose(drawn.poses()[name], pose, atol=1e-12)


def test_probabilities_are_sums_of_weights():
    _, one = part(weight=0.7)
    other = replace(one, graph=one.graph.remove("top").replace("high", name="lid"), weight=0.3)
    other = replace(other, addresses=(), values=np.zeros((2, 5, 0)))
    posterior = Posterior((one, other))
    assert posterior.object_probability("low") == pytest.approx(1.0)
    assert posterior.object_probability("top") == pytest.approx(0.7)
    missing = Posterior((one.scaled(0.7), other.scaled(0.7)))  # what was missed may have the object as well
    assert missing.object_probability("top") == pytest.approx(0.7)
    for ask in ("object_probability", "object_probability_error", "parent_probability", "shape_probability"):
        with pytest.raises(DerenderError, match="no object is called 'topp'.*did you mean 'top'"):
            getattr(posterior, ask)("topp")
    assert posterior.parent_probability("top") == {"high": 1.0}
    assert posterior.shape_probability("lid") == {"cube": 1.0}
    counts = sum("lid" in graph.names for graph in posterior.graphs(np.random.default_rng(0), 400))
    assert abs(counts - 120) < 4.5 * np.sqrt(400 * 0.21)  # binomial, one failure in 150,000


def test_what_a_search_may_have_missed_speaks_against_its_objects():
    _, one = part()
    meta = {"missed": 0.4, "wrong_if_missed": 0.5, "existence": {"low": (0.6, 0.1)}}
    posterior = Posterior((one.scaled(0.6),), meta=meta)
    assert posterior.object_probability("top") == pytest.approx(0.92)
    assert posterior.object_probability("low") == pytest.approx(0.6 * 0.92)
    free = replace(one, graph=one.graph.replace("low", shape="thing"))
    posterior = Posterior((free.scaled(0.6),), meta=meta)
    assert posterior.object_probability("low") == pytest.approx(0.6), "counted over answers that missed something too"


def test_a_free_form_thing_may_be_no_object_at_all():
    _, one = part()
    name = one.graph.names[-1]
    sure, doubted = (Posterior((one,), meta={"existence": told}) for told in ({}, {name: (0.55, 0.1)}))
    assert doubted.object_probability(name) == pytest.approx(0.55 * sure.object_probability(name))
    assert doubted.object_probability_error(name) >= 0.1 > sure.object_probability_error(name)
    assert doubted.object_probability(one.graph.names[0]) == sure.object_probability(one.graph.names[0])
    assert any(name in doubt.words and doubt.about == (name,) for doubt in chain_doubts(doubted, []))
    assert not any(name in doubt.words for doubt in chain_doubts(sure, []))


def test_each_draw_is_taken_before_one_is_taken_again():
    _, one = part()
    count = one.log_density.size
    graphs = Posterior((one,)).graphs(np.random.default_rng(0), 2 * count)
    said = [tuple(graph.numbers()[name] for name in one.addresses) for graph in graphs]
    assert len(set(said[:count])) == count and sorted(said[:count]) == sorted(said[count:])


def test_draws_that_would_come_again_are_not_counted_as_more():
    """Of 100,000 draws of four hundred P(stable) was said to be known to .1 %."""
    _, one = part()
    count = one.log_density.size
    assert len(list(Posterior((one,)).each_graph(np.random.default_rng(0), 1000))) == count > 1
    single = one.at(
        (np.zeros((1, 1), int), np.zeros((1, 1), int))
    )  # of the likeliest scene alone: for what is jittered
    assert len(list(Posterior((single,)).each_graph(np.random.default_rng(0), 50))) == 50
    other = Posterior((one.scaled(0.9), single.scaled(0.1)))
    assert count <= len(list(other.each_graph(np.random.default_rng(0), 1000))) < 2 * count


def test_a_posterior_is_one_line_where_it_is_printed():
    _, one = part()
    text = repr(Posterior((one,)))
    assert text.startswith("<Posterior, structures: 1, the best: <StructurePosterior of weight 1.000: ")
    assert "chains of" in text and len(text) < 300


def test_best_is_the_highest():
    _, one = part()
    log_prior = np.zeros((2, 5))
    log_prior[1, 2] = 50.0
    graph, density = replace(one, log_prior=log_prior).best()
    assert graph == one.graph_at(1, 2)
    assert density == pytest.approx(50.0 + one.log_likelihood[1, 2])


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"junk"])
def test_what_is_no_posterior_is_told(tmp_path, content):
    (tmp_path / "posterior.npz").write_bytes(content)
    with pytest.raises(DerenderError, match="not a posterior"):
        load(tmp_path)
    with pytest.raises(DerenderError, match="no posterior here"):
        load(tmp_path / "nowhere.npz")


def test_a_root_that_is_no_pose_is_told(tmp_path):
    _, one = part(LOOKED_AT)
    Posterior((replace(one, root_pose=np.zeros_like(one.root_pose)),)).save(tmp_path / "posterior.npz")
    with pytest.raises(DerenderError, match="its root's poses are not rigid"):
        load(tmp_path)


def test_a_full_disk_is_one_line_of_fault_for_the_netcdf_too(tmp_path, monkeypatch):
    """HDF5 tells Python of a file that it could not write once more when it closes it, when nothing can be raised."""
    pytest.importorskip("h5netcdf")
    resource = pytest.importorskip("resource")
    told, most = [], resource.getrlimit(resource.RLIMIT_FSIZE)
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    former = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, most[1]))
    try:
        with pytest.raises(DerenderError, match="cannot be written: File too large"):
            write_netcdf(tmp_path / "posterior.nc", Posterior((part()[1],), 3, "c"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, most)
        signal.signal(signal.SIGXFSZ, former)
    assert not told and not list(tmp_path.iterdir())


def test_arviz_opens_the_netcdf(tmp_path):
    pytest.importorskip("h5netcdf")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        arviz = pytest.importorskip("arviz")
        _, one = part()
        theta = one.addresses.index("low.contact.theta")
        one.values[:, :, theta] = one.periods[theta] * np.array([[0.01, 0.99, 0.02, 0.98, 0.0], [0.01] * 5])
        assert write_netcdf(tmp_path / "posterior.nc", Posterior((one,), 3, "c"))
        data = arviz.from_netcdf(str(tmp_path / "posterior.nc"))
        for address in ("low.contact.theta", one.addresses[0]):  # a chain near 0 had two modes
            draws = one.values[:, :, one.addresses.index(address)]
            wanted = unwrap(draws, one.periods[one.addresses.index(address)])
            np.testing.assert_array_equal(np.asarray(data["posterior"][address]), wanted)
        assert np.ptp(np.asarray(data["posterior"]["low.contact.theta"])) < 0.05 * one.periods[theta]
        np.testing.assert_array_equal(np.asarray(data["sample_stats"]["lp"]), one.log_density)
        assert len(arviz.summary(data)) == len(one.addresses)


def test_what_may_have_been_missed_is_part_of_a_weight_s_error():
    """Whether two searches agree differs between seeds: of one answer .005 was said to be missed, of the other .12."""
    _, one = part()
    one = replace(one, weight=0.98, weight_error=0.01, weight_interval=(0.96, 0.99))
    sure, doubtful = one.scaled(1.0 - 0.005, 0.4 * 0.005), one.scaled(1.0 - 0.12, 0.4 * 0.12)
    apart = sure.weight - doubtful.weight
    assert apart < 2.0 * math.hypot(sure.weight_error, doubtful.weight_error) + 0.02
    assert doubtful.weight_error == pytest.approx(math.hypot(0.88 * 0.01, 0.4 * 0.12 * 0.98))
    low, high = doubtful.weight_interval
    assert low < 0.8 < doubtful.weight < high < 1.0
    assert one.scaled(0.5).weight_interval == pytest.approx((0.48, 0.495))
