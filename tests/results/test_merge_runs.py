"""Several runs as one posterior."""

from dataclasses import replace

import numpy as np
import pytest

from derender.errors import DerenderError
from derender.results.posterior import Posterior, StructurePosterior, merge_runs
from derender.scene.contacts import contacts
from derender.scene.graph import ROOT, Contact, SceneGraph, Vertex
from derender.scene.pose import rotation_z, translation

ADDRESSES = tuple(f"box.contact.{key}" for key in ("theta", "x", "y"))


def run(floor_pose, values):
    """Return the posterior of a cube on a floor that was found there; values (chains, draws, 3)."""
    contact = Contact("face-to-face", "+z", "-z", dict(zip(("theta", "x", "y"), values[0, 0], strict=True)))
    floor = Vertex("floor", "plane", {}, ROOT, Contact("6dof", values=contacts["6dof"].invert(floor_pose).phi))
    graph = SceneGraph(np.eye(4), (floor, Vertex("box", "cube", {"side": 0.1}, "floor", contact)))
    zeros = np.zeros(values.shape[:2])
    return Posterior((StructurePosterior(graph, ADDRESSES, values, zeros, zeros),))


def test_all_chains_are_there_cut_to_the_shortest():
    rng = np.random.default_rng(0)
    runs = [run(np.eye(4), rng.uniform(size=(2, draws, 3))) for draws in (5, 4)]
    assert merge_runs(runs, ("a", "b")).parts[0].values.shape == (4, 4, 3)


def test_other_unknowns_are_refused_by_name():
    one = run(np.eye(4), np.ones((1, 2, 3)))
    other = replace(one, parts=(replace(one.best_part, addresses=("a", "b", "c")),))
    with pytest.raises(DerenderError, match="second.*not those of first"):
        merge_runs([one, other], ("first", "second"))


def test_a_single_scene_is_not_put_together_with_chains():
    """All chains were cut to one draw, and its ranges told as a posterior's."""
    chains, scene = run(np.eye(4), np.ones((2, 9, 3))), run(np.eye(4), np.ones((1, 1, 3)))
    with pytest.raises(DerenderError, match="second: it is one scene and no chains"):
        merge_runs([chains, scene], ("first", "second"))


@pytest.mark.parametrize("wandering", [False, True], ids=["fixed", "wandering"])
def test_a_floor_found_elsewhere_changes_no_pose(wandering):
    """Two runs whose floors have other origins and turns agree about where the box is, or they are called apart.

    A floor that wanders from draw to draw about where its run found it does so still.
    """
    rng = np.random.default_rng(1)
    there = translation(0.4, -0.2, 0.0) @ rotation_z(0.3)
    values = rng.uniform(size=(1, 6, 3))
    other = run(there, values)
    first = run(np.eye(4), rng.uniform(size=(1, 6, 3)))
    if wandering:
        other, first = (wander(rng, each) for each in (other, first))
    joined = merge_runs([first, other], ("a", "b")).parts[0]
    for draw in range(6):
        before = other.best_part.graph_at(0, draw).poses()["box"]
        after = joined.graph_at(1, draw).poses()["box"]
        np.testing.assert_allclose(after, before, atol=1e-12)  # one chain of 4 x 4 products against another
    assert not np.allclose(joined.values[1], values[0])


def test_a_cube_found_a_quarter_turn_further_bears_what_it_bore():
    """It looks the same, and its theta is the same but for its period; where on it another stands is told anew."""
    rng = np.random.default_rng(2)
    numbers = {"theta": 0.2, "u": 0.7, "v": 0.4}
    addresses = ADDRESSES + tuple(f"top.contact.{key}" for key in numbers)
    values = np.array([0.3, 0.1, 0.2, *numbers.values()]) + rng.normal(0, 0.01, (1, 6, 6))

    def stack(values):
        part = run(np.eye(4), values[..., :3]).best_part
        top = Contact("face-to-face", "+z", "-z", dict(zip(numbers, values[0, 0, 3:], strict=True)))
        graph = part.graph.add(Vertex("top", "cube", {"side": 0.08}, "box", top))
        return replace(part, graph=graph, addresses=addresses, values=values, periods=(None,) * 6)

    first = stack(values)
    turned = values.copy()
    for draw in range(6):
        poses = first.graph_at(0, draw).poses()
        poses["box"] = poses["box"] @ rotation_z(np.pi / 2)
        bodies = [first.graph.body(name) for name in ("floor", "box", "top")]
        for place, parent, child in ((0, "floor", "box"), (1, "box", "top")):
            relative = np.linalg.inv(poses[parent]) @ poses[child]
            told = contacts["face-to-face"].invert(relative, *bodies[place : place + 2], "+z", "-z").values
            turned[0, draw, 3 * place : 3 * place + 3] = list(told.values())[:3]
    assert not np.allclose(turned[..., 4:], values[..., 4:], atol=0.05)
    joined = merge_runs([Posterior((first,)), Posterior((stack(turned),))], ("a", "b")).parts[0]
    np.testing.assert_allclose(joined.values[1], values[0], atol=1e-9)


def wander(rng, posterior):
    """Return a posterior whose root is a little higher or lower in each draw."""
    part = posterior.best_part
    poses = np.array([[translation(0, 0, z) for z in chain] for chain in rng.normal(0, 0.01, part.values.shape[:2])])
    return replace(posterior, parts=(replace(part, root_pose=poses),))
