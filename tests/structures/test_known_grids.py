"""A large box of whole multiples of a known one's sides is a grid of these; another is not."""

import numpy as np
import pytest

from derender.detection.solids.image import make_row, rotation_of
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX
from derender.structures.infer import infer_structure
from derender.structures.known.library import Known, cells_of, fitted, layouts_of, numbers_of, space_of
from derender.structures.options import Options
from worlds.frontier_scenes import KINDS, make

CARTON = Known("carton", "box", {"length": 0.3, "width": 0.25, "height": 0.2}, {})
SIZE = np.array([0.3, 0.25, 0.2])


def narrowest(row):
    """Return the cells of the layout with the narrowest gaps that fills a row; (0, ROW): none does."""
    space = space_of(row)
    layouts = layouts_of(space, CARTON) if space else []
    return cells_of(layouts[0], numbers_of(space, layouts[0]), space.bottom) if layouts else np.empty((0, len(row)))


def large(sides):
    return make_row(BOX, rotation_z(0.4)[:3, :3], np.array([0.1, 0.2, 0.5 * sides[2]]), np.array(sides))


def corners(row):
    signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3), axis=-1).reshape(-1, 3)
    return row[10:13] + (signs * row[13:16]) @ rotation_of(row).T


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 0, 2), (0, 2, 1), (2, 1, 0), (1, 2, 0), (2, 0, 1)])
def test_cells_fill_the_large_box_whichever_way_they_lie(order):
    count, piece = np.array([2, 3, 2]), SIZE[list(order)]
    row = large(count * piece + [0.004, 0.008, 0.0])
    cells = narrowest(row)
    assert len(cells) == 12 and np.all(np.diff(cells[:, 12]) > -1e-9)  # lowest first
    inside = (np.concatenate([corners(cell) for cell in cells]) - row[10:13]) @ rotation_of(row)
    assert np.allclose(inside.min(axis=0), -0.5 * row[13:16]) and np.allclose(inside.max(axis=0), 0.5 * row[13:16])
    centres = (cells[:, 10:13] - row[10:13]) @ rotation_of(row) / piece
    assert np.abs(centres - np.round(2 * centres) / 2).max() < 0.03
    for cell in cells:
        assert np.linalg.det(rotation_of(cell)) == pytest.approx(1.0) and np.array_equal(cell[13:16], SIZE)


@pytest.mark.parametrize("sides", [(0.3, 0.25, 0.2), (0.45, 0.25, 0.2), (0.63, 0.25, 0.2), (0.6, 0.3, 0.2)])
def test_what_is_one_carton_or_no_multiple_is_no_grid(sides):
    assert len(narrowest(large(sides))) == 0


def test_a_leaning_box_is_no_grid():
    row = large((0.6, 0.5, 0.2))
    lean = np.array([[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]])
    assert len(narrowest(row)) == 4
    assert len(narrowest(make_row(BOX, lean @ rotation_of(row), row[10:13], row[13:16]))) == 0


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "why"),
    [(512, "a box of their size explains them as well"), (510, "slabs and gaps"), (521, "most are hidden by others")],
)
def test_a_pallet_is_said_whole(number, why):
    """A grid is placed as one body: what no pixel shows of it stays in its place, and what rests on what is right."""
    scene = make(np.random.default_rng([number, list(KINDS).index("cartons")]), "cartons")
    sides = dict(zip(("length", "width", "height"), map(float, scene.objects[0]["size"]), strict=True))
    options = Options(seed=0, method="map", known=(Known("carton", "box", sides, {}),))
    graph = infer_structure(scene.depth, scene.camera, options).best_graph()
    said, places = [name for name in graph.names if name.startswith("carton")], graph.poses()
    assert len(said) == len(graph.names) - 1 == len(scene.objects)
    true = np.array([item["pose"][:3, 3] for item in scene.objects])
    match = {name: int(np.linalg.norm(true - places[name][:3, 3], axis=1).argmin()) for name in said}
    for name in said:
        assert np.linalg.norm(true[match[name]] - places[name][:3, 3]) < 0.03
        assert match.get(graph.vertex(name).parent, "floor") == scene.objects[match[name]]["parent"]


def test_a_grid_is_fitted_to_what_shows_of_it():
    layout = layouts_of(space_of(large((0.6, 0.75, 0.4))), CARTON)[0]
    numbers = np.array([0.11, 0.19, 0.42, 0.004, 0.002])
    truth = cells_of(layout, numbers, 0.0)

    def misfit(rows):
        """Return how far the corners of the box about the rows are off those about the true ones."""
        return float(np.abs(ends(np.concatenate([corners(row) for row in rows])) - ends(shown)).sum())

    def ends(points):
        level = points @ rotation_of(truth[0])
        return np.concatenate([points.min(axis=0), points.max(axis=0), level.min(axis=0), level.max(axis=0)])

    shown = np.concatenate([corners(row) for row in truth])
    space = space_of(large((0.604, 0.752, 0.4)))
    least, cells = fitted(space, layout, misfit, np.zeros(3), np.array([0.0, -2.0, 1.0]))
    assert least < 0.004 < misfit(cells_of(layout, numbers_of(space, layout), 0.0))
    assert np.abs(cells[:, 10:13] - truth[:, 10:13]).max() < 0.002
