"""A large box of whole multiples of a known one's sides is a grid of these; another is not."""

from itertools import product

import numpy as np
import pytest

from derender.detection.solids.image import make_row, rotation_of
from derender.scene.graph import ROOT, Contact, SceneGraph, Vertex
from derender.scene.pose import rotation_z
from derender.scene.solids import BOX
from derender.structures.infer import infer_structure
from derender.structures.known.library import GAP, Known, cells_of, fitted, layouts_of, numbers_of, space_of
from derender.structures.known.posterior import laws_of
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
@pytest.mark.parametrize(
    ("number", "method", "seed", "why"),
    [
        (200, "map", 0, "the topmost of 27 are cut off by the border"),
        (512, "map", 0, "a box of their size explains them as well"),
        (510, "map", 0, "slabs and gaps"),
        (521, "map", 0, "most are hidden by others"),
        (5302, "map", 0, "in the reduced image two boxes explain more than they do"),
        (5305, "map", 0, "wide gaps that both are to grow"),
        (5305, "map", 1, "the floor was told .2 mm too high"),
        (1702, "auto", 0, "what nothing shows wandered in the draws"),
    ],
)
def test_a_pallet_is_said_whole(number, method, seed, why):
    """A grid is placed as one body: what no pixel shows of it stays in its place, and what rests on what is right."""
    scene = make(np.random.default_rng([number, list(KINDS).index("cartons")]), "cartons")
    sides = dict(zip(("length", "width", "height"), map(float, scene.objects[0]["size"]), strict=True))
    options = Options(seed=seed, method=method, known=(Known("carton", "box", sides, {}),))
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
    least, cells = fitted(space, layout, misfit, np.array([0.0, -2.0, 1.0]))
    assert least < 0.0004 < misfit(cells_of(layout, numbers_of(space, layout), 0.0))
    assert np.abs(cells[:, 10:13] - truth[:, 10:13]).max() < 0.002


def test_an_unseen_carton_of_a_grid_stands_in_its_place_but_for_the_gaps():
    """Half of a pallet shows: chains took what does not anywhere on what bears it, and said so in the best scene."""
    size = {"length": 0.4, "width": 0.3, "height": 0.2}
    face = {"parent_face": "+z", "child_face": "-z"}
    below = Contact("face-to-face", **face, values={"x": 0.3, "y": -0.2, "theta": 6.0})
    upon = Contact("face-to-face", **face, values={"u": 0.5, "v": 0.5, "theta": 0.0})
    graph = SceneGraph(np.eye(4), (Vertex("floor", "plane", {}, ROOT, Contact("6dof")),
                                   Vertex("below", "box", size, "floor", below),
                                   Vertex("upon", "box", size, "below", upon)))  # fmt: skip
    names, rng = ["below", "upon"], np.random.default_rng(0)
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * list(size.values())

    def farthest(unseen):
        """Return the metres by which a corner of either is off its place on what bears it, at most, in many draws."""
        laws = laws_of(graph, names, [], unseen)
        off = dict.fromkeys(names, 0.0)
        for name, _ in product(names, range(300)):
            own = {address: law.sample(rng) for address, law in laws.items() if address.startswith(f"{name}.")}
            parent = graph.vertex(name).parent
            drawn, true = (np.linalg.inv(each.poses()[parent]) @ each.poses()[name]
                           for each in (graph.with_numbers({**graph.numbers(), **own}), graph))  # fmt: skip
            moved = corners @ (drawn - true)[:3, :3].T + (drawn - true)[:3, 3]
            off[name] = max(off[name], np.linalg.norm(moved, axis=1).max())
        return off

    free, held = farthest([]), farthest(["below", "upon"])
    assert free["below"] > 0.1 and free["upon"] > 0.1
    for name in names:  # by a gap along either axis and by one more as it turns
        assert 0.5 * GAP < held[name] < 3.0 * GAP
