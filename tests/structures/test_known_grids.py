"""A large box of whole multiples of a known one's sides is a grid of these; another is not."""

import numpy as np
import pytest

from derender.detection.solids.image import make_row, rotation_of
from derender.evaluation.frontier_scenes import KINDS, make
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX
from derender.structures.infer import infer_structure
from derender.structures.known.identities import cells_of
from derender.structures.known.library import Known
from derender.structures.options import Options

CARTON = Known("carton", "box", {"length": 0.3, "width": 0.25, "height": 0.2}, {})
SIZE = np.array([0.3, 0.25, 0.2])


def large(sides):
    return make_row(BOX, rotation_z(0.4)[:3, :3], np.array([0.1, 0.2, 0.5 * sides[2]]), np.array(sides))


def corners(row):
    signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
    return row[10:13] + (signs * row[13:16]) @ rotation_of(row).T


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 1, 0), (1, 2, 0), (2, 0, 1)])
def test_cells_fill_the_large_box_whichever_way_they_lie(order):
    count, piece = np.array([2, 3, 2]), SIZE[list(order)]
    row = large(count * piece + [0.004, 0.008, 0.0])
    cells = cells_of(row, CARTON)
    assert len(cells) == 12 and np.all(np.diff(cells[:, 12]) > -1e-9)  # lowest first
    inside = (np.concatenate([corners(cell) for cell in cells]) - row[10:13]) @ rotation_of(row)
    assert np.allclose(inside.min(axis=0), -0.5 * row[13:16]) and np.allclose(inside.max(axis=0), 0.5 * row[13:16])
    centres = (cells[:, 10:13] - row[10:13]) @ rotation_of(row) / piece
    assert np.abs(centres - np.round(2 * centres) / 2).max() < 0.03
    for cell in cells:
        assert np.linalg.det(rotation_of(cell)) == pytest.approx(1.0) and np.array_equal(cell[13:16], SIZE)


@pytest.mark.parametrize("sides", [(0.3, 0.25, 0.2), (0.45, 0.25, 0.2), (0.63, 0.25, 0.2), (0.6, 0.3, 0.2)])
def test_what_is_one_carton_or_no_multiple_is_no_grid(sides):
    assert len(cells_of(large(sides), CARTON)) == 0


def test_a_leaning_box_is_no_grid():
    row = large((0.6, 0.5, 0.2))
    lean = np.array([[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]])
    assert len(cells_of(row, CARTON)) == 4
    assert len(cells_of(make_row(BOX, lean @ rotation_of(row), row[10:13], row[13:16]), CARTON)) == 0


@pytest.mark.slow
def test_flush_cartons_of_known_size_are_told_apart():
    scene = make(np.random.default_rng([1, list(KINDS).index("cartons")]), "cartons")
    sides = dict(zip(("length", "width", "height"), map(float, scene.objects[0]["size"]), strict=True))
    options = Options(seed=0, method="map", known=(Known("carton", "box", sides, {}),))
    graph = infer_structure(scene.depth, scene.camera, options).best_graph()
    said = np.array([pose[:3, 3] for name, pose in graph.poses().items() if name.startswith("carton")])
    true = np.array([item["pose"][:3, 3] for item in scene.objects])
    assert len(said) == len(true)
    assert np.linalg.norm(said[:, None] - true, axis=2).min(axis=0).max() < 0.03


@pytest.mark.slow
def test_an_answer_that_leaves_much_unexplained_is_not_sure():
    """27 cartons of which the topmost are out of the image, so that they are no whole multiple."""
    scene = make(np.random.default_rng([200, list(KINDS).index("cartons")]), "cartons")
    sides = dict(zip(("length", "width", "height"), map(float, scene.objects[0]["size"]), strict=True))
    options = Options(seed=0, method="map", known=(Known("carton", "box", sides, {}),))
    posterior = infer_structure(scene.depth, scene.camera, options)
    assert posterior.explanation.share(scene.depth) < 0.95 and posterior.best_part.weight < 0.95
