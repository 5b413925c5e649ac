"""Who bears a solid's weight, against MuJoCo's contact forces and by the lever rule."""

import numpy as np
import pytest

from derender.detection.solids.image import make_row
from derender.detection.solids.state import FLOOR
from derender.detection.solids.support import contacts_of, least_forces, shares_of_load
from derender.scene.separation import surface_distance
from derender.scene.solids import BOX, CYLINDER, KINDS, SPHERE
from worlds.made_scenes import random_size, settle


def upright(centre, size, kind=BOX):
    return make_row(kind, np.eye(3), centre, size)


def test_what_bears_most_is_what_mujoco_says():
    rng = np.random.default_rng(3)
    told = 0
    for _ in range(4):
        kinds = [str(rng.choice(["box", "cube"])) for _ in range(10)]
        sizes = np.array([random_size(rng, kind, 0.06, 0.12) for kind in kinds])
        settled = settle(rng, kinds, sizes, 0.02, 0.0, 6.0)  # tumbled: some lean on others
        if settled is None:
            continue
        poses, parents = settled
        rows = np.array([make_row(KINDS[k], p[:3, :3], p[:3, 3], s)
                         for k, p, s in zip(kinds, poses, sizes, strict=True)])  # fmt: skip
        for k, parent in enumerate(parents):
            shares = shares_of_load(rows, k, 0.002)
            assert max(shares, key=lambda j: shares[j]) == (FLOOR if parent == "floor" else parent)
            told += parent != "floor"
    assert told > 1


def test_a_beam_on_two_posts_is_shared_by_the_lever_rule():
    beam = upright([0.0, 0.0, 0.12], [0.4, 0.02, 0.04])
    posts = [upright([x, 0.0, 0.05], [0.01, 0.02, 0.1]) for x in (-0.05, 0.15)]
    shares = shares_of_load(np.array([beam, *posts]), 0, 0.003)
    assert shares[1] == pytest.approx(0.75, abs=0.05) and shares[2] == pytest.approx(0.25, abs=0.05)
    assert FLOOR not in shares


def test_what_would_tip_off_is_borne_by_nobody():
    rows = np.array([upright([0.09, 0.0, 0.15], [0.1, 0.1, 0.1]), upright([0.0, 0.0, 0.05], [0.1, 0.1, 0.1])])
    assert shares_of_load(rows, 0, 0.003) == {}
    rows[0, 10] = 0.03
    assert shares_of_load(rows, 0, 0.003) == {1: pytest.approx(1.0)}


@pytest.mark.parametrize("kind", [BOX, SPHERE, CYLINDER])
def test_distances_are_to_the_surface(kind):
    points = np.array([[0.0, 0.0, 0.08], [0.0, 0.045, 0.0]])
    assert surface_distance(kind, np.full(3, 0.1), points) == pytest.approx([0.03, -0.005])


@pytest.mark.parametrize("kind", [BOX, SPHERE, CYLINDER])
def test_what_stands_on_a_box_is_pushed_up_by_it(kind):
    below = upright([0.0, 0.0, 0.05], [0.1, 0.1, 0.1])
    rows = np.array([upright([0.03, 0.02, 0.149], [0.1, 0.1, 0.1], kind), below])
    carriers, points, normals = contacts_of(rows, 0, 0.003)
    assert set(carriers) == {1} and np.allclose(normals, [0, 0, 1.0]) and np.allclose(points[:, 2], 0.1, atol=0.002)


@pytest.mark.parametrize("count", [1, 12, 96, 288])
def test_forces_are_those_of_scipys_non_negative_least_squares(count):
    optimize = pytest.importorskip("scipy.optimize")
    for seed in range(10):
        matrix = np.random.default_rng(seed).normal(size=(6, count))
        weight, ridge = np.eye(6)[2], 0.1 * np.eye(count)
        found = least_forces(matrix, weight, 0.1**2)
        expected, _ = optimize.nnls(np.vstack([matrix, ridge]), np.concatenate([weight, np.zeros(count)]))
        np.testing.assert_allclose(found, expected, atol=1e-8)
