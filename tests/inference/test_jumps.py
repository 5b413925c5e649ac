"""Every reversible jump: there and back, its Jacobian by differences, invariance of the prior, broken twins that fail."""

import math

import numpy as np
import pytest
from tests.inference.jump_worlds import TEXTS, generator, prior_of

from derender.inference.structure.jumps.base import Applied, log_proposal_ratio, moves
from derender.inference.structure.jumps.vocabulary import Vocabulary
from derender.model.pose import from_quaternion, from_rotation_vector, quaternion
from derender.model.priors.values import ROTATION


@pytest.fixture(scope="module", params=list(TEXTS))
def words(request):
    return Vocabulary(prior_of(request.param))


def draws(words, move, seed, wanted, tries=4000):
    """Yield (graph, choice, applied, log ratio) of moves that are possible."""
    rng, found = generator(seed), 0
    for _ in range(tries):
        graph = words.prior.sample(rng)
        choice = move.draw(rng, words, graph)
        if choice is None:
            continue
        applied, ratio = log_proposal_ratio(move, words, graph, choice)
        if applied is None:
            continue
        yield graph, choice, applied, ratio
        found += 1
        if found == wanted:
            return


def solids_by_name(graph):
    """Return {name: (kind, parent, contact, numbers ...)} with floats rounded, to compare scenes as sets."""
    return {
        vertex.name: (
            vertex.shape,
            vertex.parent,
            (vertex.contact.type, vertex.contact.parent_face, vertex.contact.child_face),
            dict(vertex.parameters),
            dict(vertex.contact.values),
        )
        for vertex in graph.vertices
    }


def close(first, second, tolerance=1e-7):
    """Assert that two nests of tuples, dicts, numbers and words agree; rotations up to sign, angles up to a turn."""
    if isinstance(first, dict):
        first, second = _signed(first), _signed(second)
        assert set(first) == set(second), (first, second)
        for key in first:
            if key == "theta" or (isinstance(key, tuple) and key[-1] == "theta"):
                # a difference of 1e-16 at the period's end turns 0 into the period: compare on the circle
                gap = abs(first[key] - second[key])
                gaps = [abs(gap - math.tau / order) for order in (1, 2, 4)]
                assert min(gap, *gaps) < tolerance
            else:
                close(first[key], second[key], tolerance)
    elif isinstance(first, tuple | list):
        assert len(first) == len(second), (first, second)
        for a, b in zip(first, second, strict=True):
            close(a, b, tolerance)
    elif isinstance(first, np.ndarray):
        assert np.allclose(first, second, atol=tolerance)
    elif isinstance(first, float):
        assert abs(first - second) < tolerance, (first, second)
    elif hasattr(first, "__dataclass_fields__"):
        close({k: getattr(first, k) for k in first.__dataclass_fields__},
              {k: getattr(second, k) for k in first.__dataclass_fields__}, tolerance)  # fmt: skip
    else:
        assert first == second, (first, second)


def _signed(values):
    if set(ROTATION) <= set(values):
        quat = np.array([values[part] for part in ROTATION])
        quat = quat * np.sign(quat[np.argmax(np.abs(quat))])
        return {**values, **dict(zip(ROTATION, map(float, quat), strict=True))}
    return values


@pytest.mark.parametrize("name", moves.names())
def test_there_and_back(words, name):
    """The way back restores the scene and the choices, and negates the log ratio (to 1e-6: two inversions of poses)."""
    for graph, choice, applied, ratio in draws(words, moves[name], 1, 25, tries=400):
        back, back_ratio = log_proposal_ratio(moves[name], words, applied.graph, applied.back)
        assert back is not None
        assert abs(ratio + back_ratio) < 1e-6
        close(solids_by_name(back.graph), solids_by_name(graph))
        assert np.allclose(back.graph.root_pose, graph.root_pose, atol=1e-9)
        close(back.back, choice)


# ---- Jacobians by finite differences ----


class Numbers:
    """All continuous numbers of (graph, choice) as one vector that can be read, shifted, and read again.

    A number is free if the prior or the move says so: those of the vertices' free numbers and every float in the
    choice, rotations by tangent vectors in their own axes (8 pi^2 of which make up Haar's mass of one).
    """

    def __init__(self, words, graph, choice):
        self.words, self.graph, self.choice = words, graph, choice

    def read(self):
        """Return a list of (address, value): floats, or (4,) quaternions."""
        found = []
        for vertex in sorted(self.graph.vertices, key=lambda vertex: vertex.name):
            for part, key in self.words.free_numbers(self.graph, vertex.name):
                if key == "quat_wxyz":
                    quat = np.array([vertex.contact.values[p] for p in ROTATION])
                    found.append(((vertex.name, key), quat))
                else:
                    source = vertex.parameters if part == "shape" else vertex.contact.values
                    found.append(((vertex.name, part, key), source.get(key, 0.0)))
        _walk(self.choice, ("choice",), found, self.words, self.graph)
        return found


def _walk(item, address, found, words, graph):
    from derender.model.contacts import contacts
    from derender.model.scene import Contact, Vertex
    from derender.model.shapes import shapes

    if isinstance(item, Vertex):
        entry = next(e for e in words.shapes.values() if e.matches(item))
        for key in entry.free():
            found.append(((*address, "shape", key), item.parameters[key]))
        table = words.table(*words.seat(graph, item.parent), item.shape,
                            (item.contact.type, item.contact.parent_face, item.contact.child_face))  # fmt: skip
        _contact(item.contact, table, (*address, "contact"), found)
    elif isinstance(item, Contact):
        vertex = graph.vertex(address_name(address, found))
        table = words.table(*words.seat(graph, found[-1] if False else vertex.parent), vertex.shape,
                            (item.type, item.parent_face, item.child_face))  # fmt: skip
        _contact(item, table, address, found)
    elif isinstance(item, dict):
        for key in sorted(item, key=str):
            _walk(item[key], (*address, key), found, words, graph)
    elif isinstance(item, float):
        found.append((address, item))
    elif isinstance(item, tuple | list):
        quat = len(address) and isinstance(address[-1], tuple) and address[-1][-1] == "quat_wxyz" and len(item) == 4
        if quat:
            found.append((address, np.array(item)))
        else:
            for number, part in enumerate(item):
                _walk(part, (*address, number), found, words, graph)
    del contacts, shapes
