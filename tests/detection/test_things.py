"""Free-form things: a bowl is one thing and a box stays a box; the pieces of a surface; its closed surface."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from table_scenes import CAMERA, TABLE, blob, bowl, seen_on_the_table

import derender
from derender.camera.intrinsics import Camera
from derender.camera.windows import greatest, least
from derender.detection import estimate
from derender.detection.compounds import (
    falling,
    goes_on,
    hangs_on,
    held_by_another,
    hollow,
    meets,
    neck,
    part_of_another,
    slope_of,
)
from derender.detection.compounds import joined as joined_parts
from derender.detection.estimate import point_estimate
from derender.detection.freestanding import existence_of, outstanding
from derender.detection.leftovers import leftovers, swaps
from derender.detection.outline import foot_radius, vertical_axis
from derender.detection.patches import APART, SeenSurface, straightest
from derender.detection.search.bodies import label_bodies
from derender.detection.search.greedy import Settings
from derender.detection.search.observation import observe
from derender.detection.segments import joined, one_rim
from derender.detection.solids.beliefs import bare_image
from derender.detection.solids.image import make_image, make_row, taps_of
from derender.detection.solids.polish import FREE, UPRIGHT
from derender.detection.solids.state import FLOOR, State, held_out
from derender.detection.things import (
    BAD,
    STRAIGHTEST,
    Cost,
    clear_of_edges,
    cost_of,
    likely_things,
    low_parts,
    made_thing,
    nats_of_joins,
    silhouette,
    take_things,
    without_background,
)
from derender.report.scene_json import scene_json
from derender.scene.pose import rotation_x, translation
from derender.scene.priors.bare_image import Things
from derender.scene.solids import BOX, CYLINDER, MESH, SPHERE
from derender.structures.free_forms import closed_surface, surface_of, visible_surface
from derender.structures.infer import infer_structure
from derender.structures.options import Options
from worlds.frontier_scenes import KINDS, make


def surface_through(points):
    """Return the surface through points (H, W, 3), a pixel of which is some two millimetres wide."""
    even = np.full(points.shape[:2], 0.01)
    return SeenSurface(points, even > 0.0, 0.2 * even, even, np.zeros(3))


@pytest.fixture(scope="module")
def scene():
    """A bowl and a box beside it, as inferred."""
    image = seen_on_the_table([
        (MESH, -0.09, 0.0, (0.14, 0.14, 0.06), bowl()), (BOX, 0.1, 0.0, (0.09, 0.07, 0.12), None),
    ])  # fmt: skip
    return image, infer_structure(image, CAMERA, Options(seed=0, chains=2, draws=40))


@pytest.mark.slow
def test_a_bowl_is_one_thing_and_a_box_a_box(scene):
    _, found = scene
    graph = found.best_graph()
    kinds = sorted(graph.vertex(name).shape for name in graph.names)
    assert kinds == ["box", "plane", "thing"]
    thing = next(name for name in graph.names if graph.vertex(name).shape == "thing")
    assert graph.vertex(thing).parent == "floor"
    assert np.allclose(graph.body(thing).size(), [0.14, 0.14, 0.06], rtol=0.1)
    assert found.parts[0].values.shape[2] == len(found.parts[0].addresses)


@pytest.mark.slow
def test_the_intervals_of_a_things_size_hold_the_best_one(scene):
    posterior = scene[1]
    told = next(item for item in scene_json(posterior.best_graph(), posterior)["objects"] if item["type"] == "thing")
    for size, (low, high) in zip(told["size"], told["size_interval"], strict=True):
        assert low < size < high


def test_a_solid_of_which_hardly_anything_is_seen_is_there_by_chance():
    """A box that fits a few pixels beside a hole, and would fill the hole, was an object."""
    image = seen_on_the_table([(BOX, -0.12, 0.0, (0.08, 0.08, 0.1), None), (BOX, 0.1, 0.0, (0.1, 0.1, 0.08), None)])
    seen, state = observe(image, CAMERA), State()
    to_floor = np.linalg.inv(seen.floor.pose) @ TABLE
    for x, size in ((-0.12, (0.08, 0.08, 0.1)), (0.1, (0.1, 0.1, 0.08))):
        place = to_floor @ translation(x, 0.0, 0.5 * size[2])
        state = state.add(make_row(BOX, place[:3, :3], place[:3, 3], np.array(size)), UPRIGHT, False)
    assert len(without_background(seen, state, [], Settings())[1]) == 2
    right = silhouette(seen.image, state, 1)
    hole = right & (np.cumsum(right, axis=0) > 0.2 * right.sum(axis=0))  # a fifth of each column is left, its top
    holed = observe(np.where(hole, np.nan, image), CAMERA)
    there, kept, _ = without_background(holed, state, [], Settings())
    assert len(kept) == 1 and kept.rows[0, 10] < 0.0
    assert there.behind[right & ~hole].mean() > 0.8


def test_a_solid_is_background_only_with_what_nothing_explains_below_it():
    """The image's border cut a drawer unit: over its unexplained foot as a box it was a wall, as a thing an object."""
    image = seen_on_the_table([(BOX, 0.28, -0.05, (0.16, 0.12, 0.24), None)])
    seen = observe(image, CAMERA)
    place = np.linalg.inv(seen.floor.pose) @ TABLE @ translation(0.28, -0.05, 0.15)
    upper = make_row(BOX, place[:3, :3], place[:3, 3], np.array([0.16, 0.12, 0.18]))
    _, kept, _ = without_background(seen, State().add(upper, FREE, False), [], Settings())
    assert len(kept) == 1


def test_what_the_border_cuts_is_background_and_yet_told_as_what_may_be_an_object():
    """A banana that the border cut was taken for an arm, and nothing spoke against the scene without it."""
    seen = observe(seen_on_the_table([(BOX, 0.28, -0.05, (0.16, 0.12, 0.24), None)]), CAMERA)
    upper = seen.mask & (seen.points[..., 2] > 0.1) & (seen.points[..., 2] < 0.2)
    assert upper[:, -1].any() and upper.sum() > 100
    there, _, masks = without_background(seen, State(), [upper], Settings())
    ((mask, probability),) = there.cut_short
    assert not masks and not there.clutter and there.behind[upper].all() and (mask == upper).all()
    assert 0.4 < probability < 0.5
    inner = np.roll(upper, -20, axis=1)  # not cut
    assert not without_background(seen, State(), [inner], Settings())[0].cut_short


def test_a_thing_has_the_low_parts_that_it_goes_on_into():
    """Of a torch on a bin's rough floor half was the floor."""
    height = np.zeros((30, 40))
    height[10:13, 10:30] = 0.03  # a ridge, four times the noise
    height[13:20, 10:30] = height[24:28, 10:20] = 0.01  # its flank, and a dent of the floor
    height[13:20, 26:30] = 0.006  # too low
    column, row = np.meshgrid(np.arange(40.0), np.arange(30.0))
    points = np.stack([0.005 * column, 0.005 * row, height], axis=-1)
    weight, sigma = np.ones(height.shape), np.full(height.shape, 0.004)
    surface = SeenSurface.of(points, weight > 0, np.full(height.shape, 0.005), sigma, np.array([0.0, 0.0, 1.0]))
    seen = SimpleNamespace(points=points, image=SimpleNamespace(weight=weight), floor_scale=1.0, mask=height > 0.016,
                           sigma=sigma, surface=surface)  # fmt: skip
    ridge, flank = height == 0.03, np.zeros(height.shape, bool)
    flank[13:20, 10:26] = True
    assert np.array_equal(low_parts(seen, ridge, ridge), flank)
    other = ridge | (column > 20)  # which is another's
    assert np.array_equal(low_parts(seen, ridge, other), flank & ~other)


def test_a_thing_that_stands_alone_has_draws_of_its_own():
    """Of a scene without solids there was one draw, and all its intervals were points."""
    image = seen_on_the_table([(MESH, 0.0, 0.0, (0.14, 0.14, 0.06), bowl())])
    posterior = infer_structure(image, CAMERA, Options(seed=0, chains=2, draws=40))
    item = next(item for item in scene_json(posterior.best_graph(), posterior)["objects"] if item["type"] == "thing")
    assert posterior.best_part.values.shape[:2] == (2, 40)
    for true, (low, high) in zip((0.14, 0.14, 0.06), item["size_interval"], strict=True):
        assert low - 0.001 < true < high + 0.001 and high - low < 0.05  # a pixel is 5 mm wide there


def test_the_thing_explains_what_is_seen_of_it(scene):
    image, found = scene
    told = found.explanation
    assert told.share(image, within=0.01) > 0.98
    assert (told.label == told.names.index("thing_1")).sum() > 280


@pytest.mark.slow
def test_a_closed_surface_is_watertight_and_hides_nothing_that_is_seen():
    image = seen_on_the_table([(MESH, 0.0, 0.0, (0.14, 0.14, 0.06), bowl())])
    _, seen = point_estimate(np.random.default_rng(0), image, CAMERA)
    (thing,) = seen.things
    jump = APART * seen.footprint
    vertices, triangles = closed_surface(seen.image, thing.mask, thing.row, jump)
    ways = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    there, back = (np.sort(each @ [len(vertices), 1]) for each in (ways, ways[:, ::-1]))
    assert np.array_equal(there, back)  # along each edge as many triangles one way as the other: closed
    assert 2e-4 < trimesh.Trimesh(vertices, triangles, process=False).volume < 2e-3  # outward, and no more than its box
    assert (np.abs(vertices) <= 0.5 * thing.row[13:] + 1e-12).all()
    text, size, _ = surface_of(seen.image, thing.mask, thing.row, jump)
    assert text and np.allclose(size, thing.row[13:], atol=2e-3)


def test_pieces_are_joined_where_their_edge_is_short():
    points, label = np.zeros((4, 4, 3)), np.repeat([[0, 0, 1, 1]], 4, axis=0)
    points[:, 2:, 2] = 0.5  # far apart in height: not the two sides of one rim
    for metres, things in ((0.04, 1), (0.2, 2)):
        edges = np.array([[0.0, metres], [metres, 0.0]])
        owner, least = joined(surface_through(points), label, edges, 47.0, 23.0 / 0.03, np.full(2, 0.01), Things())
        assert len(np.unique(owner)) == things
        assert least[owner] == pytest.approx(47.0 - metres * 23.0 / 0.03 if things == 1 else np.inf)
    edges = np.array([[0.0, 0.02], [0.02, 0.0]])
    _, least = joined(surface_through(points), label, edges, 47.0, 23.0 / 0.03, np.array([0.01, 0.0007]), Things())
    assert np.isinf(least).all()  # a handle is no object of its own


def test_a_thing_of_pieces_that_might_be_two_is_less_sure_to_be_one(monkeypatch):
    seen, settings = observe(seen_on_the_table([(BOX, 0.0, 0.0, (0.1, 0.1, 0.1), None)]), CAMERA), Settings()
    cost, existence = cost_of(seen, settings.believed.loose.things), bare_image().loose.existence
    assert np.isinf(nats_of_joins(seen, seen.mask, cost, settings))  # of one piece
    (whole,) = likely_things(seen, State(), [seen.mask], settings)[1]
    for owner, gain in (([0, 0], 5.0), ([0, 1], np.inf)):  # joined by its edges alone, and for other reasons, too
        monkeypatch.setattr("derender.detection.things.segments", lambda *_: (np.full(seen.mask.shape, -1), 2, None))
        made = np.array(owner), np.array([5.0, np.inf])
        monkeypatch.setattr("derender.detection.things.joined", lambda *_, made=made: made)
        assert nats_of_joins(seen, seen.mask, cost, settings) == gain
    monkeypatch.setattr("derender.detection.things.nats_of_joins", lambda *_: existence.one)
    (pieces,) = likely_things(seen, State(), [seen.mask], settings)[1]
    assert pieces.existence[0] == pytest.approx(0.5 * whole.existence[0])
    assert pieces.clutter == whole.clutter == 1.0 - whole.existence[0]  # several objects are something, too
    monkeypatch.setattr("derender.detection.things.nats_of_joins", lambda *_: 0.0)
    monkeypatch.setattr("derender.detection.things.existence_of", lambda *_: (0.6, 0.1))
    left, things = likely_things(seen, State(), [seen.mask], settings)  # one object at .07, none at .4
    assert not things and [p for _, p in left.clutter] == [0.6] and left.behind[seen.mask].all()
    told = [existence.joined((0.9, 0.0), gain)[0] for gain in (0.0, 10.0, 20.0, 50.0, np.inf)]
    assert (np.diff(told) > 0.0).all() and told[-1] == 0.9


def test_a_body_many_times_as_large_costs_as_much_and_is_joined_as_readily():
    points, label = np.zeros((4, 4, 3)), np.repeat([[0, 0, 1, 1]], 4, axis=0)
    points[:, 2:, 2] = 0.5
    mask, even, believed = np.ones((2, 2), bool), np.full((2, 2), 0.25), Things()
    prices = []
    for times in (1.0, 5.0):
        edges, area = 0.05 * times * np.array([[0.0, 1.0], [1.0, 0.0]]), np.full(2, 0.5 * (believed.wide * times) ** 2)
        owner, _ = joined(surface_through(points), label, edges, 47.0, 23.0 / 0.03, area, believed)
        assert len(np.unique(owner)) == 1
        prices.append(
            Cost(even * (believed.wide * times) ** 2, even * 0.3 * times, even, points, believed).numbers(mask)
        )
    assert prices[0] == pytest.approx(prices[1])


def test_what_hangs_in_the_air_goes_on_into_what_holds_it_and_what_stands_on_it_does_not():
    column, wide, tall = trimesh.creation.box([0.1, 0.1, 0.2]), trimesh.creation.box([0.2, 0.2, 0.1]), 0.1
    wide.apply_translation([0.0, 0.0, -0.05])
    column.apply_translation([0.0, 0.0, 0.0])
    narrow = trimesh.creation.box([0.1, 0.1, 0.1])
    narrow.apply_translation([0.0, 0.0, 0.05])
    for whole, expected in ((column, (0, 1)), (trimesh.util.concatenate([narrow, wide]), None)):
        mesh = whole.vertices, np.ascontiguousarray(whole.faces, np.int32)
        seen = observe(seen_on_the_table([(MESH, 0.0, 0.0, tuple(whole.extents), mesh)]), CAMERA)
        normal = seen.surface.normals(seen.surface.good)
        over = seen.points[..., 2] > tall + 0.002
        masks = [seen.mask & over, seen.mask & ~over]
        assert min(mask.sum() for mask in masks) > 50
        assert part_of_another(seen, State(), masks, normal) == expected


def test_of_what_is_seen_from_above_alone_nothing_hangs():
    """Packs thrown into a bin were one thing: each went on into the next, and its top was over the bin's floor."""
    above = translation(0.0, 0.02, 0.75) @ rotation_x(np.pi)
    beside = [(BOX, x, 0.0, (0.1, 0.1, 0.08), None) for x in (-0.05, 0.05)]
    seen = observe(seen_on_the_table(beside, table=above), CAMERA)
    column = np.indices(seen.mask.shape)[1]
    left = seen.mask & (column < np.median(column[seen.mask]))
    normal = seen.surface.normals(seen.surface.good)
    assert part_of_another(seen, State(), [left, seen.mask & ~left], normal) is None


def test_a_small_piece_in_the_air_is_part_of_the_free_form_thing_that_bears_it():
    """The heads of persons were objects of their own, with a box down to the floor."""
    torso, head = trimesh.creation.box([0.2, 0.1, 0.2]), trimesh.creation.icosphere(radius=0.04)
    head.apply_translation([0.0, 0.0, 0.13])
    whole = trimesh.util.concatenate([torso, head])
    whole.apply_translation(-whole.bounds.mean(axis=0))
    mesh = whole.vertices, np.ascontiguousarray(whole.faces, np.int32)
    seen = observe(seen_on_the_table([(MESH, 0.0, 0.0, tuple(whole.extents), mesh)]), CAMERA)
    over = seen.points[..., 2] > 0.202
    masks = [seen.mask & over, seen.mask & ~over]
    normal = seen.surface.normals(seen.surface.good)
    assert part_of_another(seen, State(), masks, normal) == (0, 1)


@pytest.mark.parametrize(
    "body, place, expected",
    [("ball", (0.02, 0.0, 0.1), (0, 1)), ("ball", (0.11, 0.0, -0.01), None), ("block", (0.0, 0.0, 0.11), None)],
)
def test_a_large_piece_on_a_dome_is_part_of_it_and_one_beside_it_or_on_a_flat_top_is_not(body, place, expected):
    """A duck was two things, surely: its head is as large as what is seen of its body."""
    if body == "ball":
        below = trimesh.creation.icosphere(radius=0.06)
        below.apply_scale([1.2, 1.0, 1.0])
    else:
        below = trimesh.creation.box([0.14, 0.14, 0.12])
    head = trimesh.creation.icosphere(radius=0.05)
    head.apply_translation(place)
    whole = trimesh.util.concatenate([below, head])
    middle = whole.bounds.mean(axis=0)
    whole.apply_translation(-middle)
    mesh = whole.vertices, np.ascontiguousarray(whole.faces, np.int32)
    seen = observe(seen_on_the_table([(MESH, 0.0, 0.0, tuple(whole.extents), mesh)]), CAMERA)
    lies = (np.linalg.inv(TABLE) @ seen.floor.pose)[:3]
    points = seen.points @ lies[:, :3].T + lies[:, 3] - [0.0, 0.0, 0.5 * whole.extents[2]] + middle
    over = seen.mask & (np.linalg.norm(points - place, axis=2) < 0.055)
    masks = [over, seen.mask & ~over]
    assert min(mask.sum() for mask in masks) > 50
    assert part_of_another(seen, State(), masks, seen.surface.normals(seen.surface.good)) == expected


@pytest.mark.parametrize("behind, touches", [(0.005, True), (0.02, False)])
def test_what_lies_well_behind_something_does_not_touch_it(behind, touches):
    """A cube was taken for a part of a tool that hung behind it."""
    y, x = np.indices((12, 12)) * 0.002
    piece = np.repeat([[0] * 6 + [1] * 6], 12, axis=0)
    points = np.stack([x, y, 1.0 + behind * piece], axis=-1)
    touched, *_ = meets(surface_through(points), piece, 0, 2, np.zeros_like(points))
    assert (touched[1] > 0) == touches


@pytest.mark.parametrize("reach, expected", [(0.008, None), (0.03, (1, 0))])
def test_what_shows_next_to_nothing_on_a_solid_s_side_makes_no_other_thing_of_it(reach, expected):
    """A cube of 3,000 pixels was no cube because of 89 that a smoothed edge had beside it."""
    size = np.array([0.12, 0.1, 0.2])
    seen = observe(seen_on_the_table([(BOX, 0.0, 0.0, tuple(size), None)]), CAMERA)
    place = np.linalg.inv(seen.floor.pose) @ TABLE
    centre = place[:3] @ [0.0, 0.0, 0.1, 1.0]
    state = State().add(make_row(BOX, place[:3, :3], centre, size), UPRIGHT, False, FLOOR, 0.0)
    near = np.abs((seen.points - centre) @ place[:3, :3])
    patch = seen.mask & (near[..., 0] < reach) & (near[..., 2] < reach)
    assert patch.sum() >= 12
    assert part_of_another(seen, state, [patch], seen.surface.normals(seen.surface.good)) == expected


@pytest.mark.parametrize("share, expected", [(0.08, (0, 1)), (0.3, None)])
def test_what_shows_little_beside_a_thing_along_which_it_lies_is_part_of_it(share, expected):
    """A strip along the leg of a person was an object of its own."""
    seen = observe(seen_on_the_table([(BOX, 0.0, 0.0, (0.2, 0.1, 0.2), None)]), CAMERA)
    column = np.indices(seen.mask.shape)[1]
    strip = seen.mask & (column < np.quantile(column[seen.mask], share))
    normal = seen.surface.normals(seen.surface.good)
    assert part_of_another(seen, State(), [strip, seen.mask & ~strip], normal) == expected


def test_a_box_is_likelier_than_a_free_form_and_a_bowl_is_none():
    box, rng = (BOX, 0.0, 0.0, (0.09, 0.07, 0.12), None), np.random.default_rng(0)
    for solid, likely in ((box, True), ((MESH, 0.0, 0.0, (0.14, 0.14, 0.06), bowl()), False)):
        seen = observe(seen_on_the_table([solid]), CAMERA)
        seen = seen._replace(things=(made_thing(seen, State(), seen.mask, (1.0, 0.0)),))
        (swap,) = swaps(rng, seen, State(), Settings())
        assert swap.odds == 0.0 if likely else swap.odds < -20.0
    seen = observe(seen_on_the_table([box]), CAMERA)
    place = np.linalg.inv(seen.floor.pose) @ TABLE
    row = make_row(BOX, place[:3, :3], place[:3] @ [0.0, 0.0, 0.06, 1.0], np.array([0.09, 0.07, 0.12]))
    (swap,) = swaps(rng, seen, State().add(row, UPRIGHT, False, FLOOR, 0.0), Settings())
    assert swap.odds < -20.0


@pytest.mark.parametrize("seed", [0, 1])
def test_what_no_solid_is_like_is_one_thing_where_noise_is_independent(seed):
    """Creases were taken for noise, and cylinders and spheres explained the lobes."""
    size = 0.16 * np.ptp(blob(seed)[0], axis=0) / np.ptp(blob(seed)[0], axis=0).max()
    image = seen_on_the_table([(MESH, 0.0, 0.0, size, blob(seed))])
    found = derender.infer(derender.DepthImage(image, CAMERA), seed=1)
    assert [each.type for each in found.objects] == ["thing"]


def test_independent_noise_leaves_this_much_along_the_straightest_line():
    """A plane leaves half a nat of a pixel, of which the mean of so many is known to a hundredth."""
    plane = 1.0 / (1.0 + 0.002 * np.arange(100) + 0.003 * np.arange(100)[:, None])
    seen = plane + 1e-4 * np.random.default_rng(0).standard_normal(plane.shape)
    left = straightest(seen, np.ones(plane.shape, bool))
    assert not np.isfinite(left[[0, 0, -1, -1], [0, -1, 0, -1]]).any()
    assert 0.5 * STRAIGHTEST * left[1:-1, 1:-1].mean() / 1e-8 == pytest.approx(0.5, rel=0.05)
    assert straightest(plane, np.ones(plane.shape, bool))[1:-1, 1:-1].max() < 1e-20


def test_what_a_solid_s_edges_mix_makes_no_free_form_of_it():
    """A right stack in a reduced image was two things, for a free form went through what its edges mix."""
    size, rng = np.array([0.2, 0.16, 0.2]), np.random.default_rng(1)
    image = seen_on_the_table([(BOX, 0.0, 0.0, size, None)])
    near, far, share = least(image, 1), greatest(image, 1), rng.random(image.shape)
    mixed = (far - near > 0.03) & (rng.random(image.shape) < 0.4)
    seen = observe(np.where(mixed, near + share * (far - near), image), CAMERA)
    place = np.linalg.inv(seen.floor.pose) @ TABLE
    row = make_row(BOX, place[:3, :3], place[:3] @ [0.0, 0.0, 0.1, 1.0], size)
    kept, masks = take_things(seen, State().add(row, UPRIGHT, False, FLOOR, 0.0), Settings())
    assert len(kept) == 1 and not masks


def test_a_thing_has_what_the_edges_of_the_solids_it_replaces_mixed():
    """Pixels at those edges were no part of a bowl, and spheres and cubes explained them beside it."""
    image = seen_on_the_table([(MESH, 0.0, 0.0, (0.14, 0.14, 0.06), bowl())])
    seen = observe(image, CAMERA)
    place, size = np.linalg.inv(seen.floor.pose) @ TABLE, np.array([0.06, 0.06, 0.03])
    state = State()
    for x in (-0.03, 0.03):
        row = make_row(BOX, place[:3, :3], place[:3] @ [x, 0.0, 0.015, 1.0], size)
        state = state.add(row, UPRIGHT, False, FLOOR, 0.0)
    _, (alone,) = take_things(observe(image, CAMERA), State(), Settings())
    kept, (mask,) = take_things(seen, state, Settings())
    assert len(kept) == 0 and np.array_equal(mask, alone)


def test_pieces_that_meet_in_a_neck_are_two_things_unless_one_is_small():
    points, label = np.zeros((4, 4, 3)), np.repeat([[0, 0, 1, 1]], 4, axis=0)
    points[:, 2:, 2] = 0.5
    edges = np.array([[0.0, 0.012], [0.012, 0.0]])
    for area, things in (([0.007, 0.006], 2), ([0.007, 0.0006], 1)):
        owner, _ = joined(surface_through(points), label, edges, 47.0, 23.0 / 0.03, np.array(area), Things())
        assert len(np.unique(owner)) == things


def test_a_silhouette_lies_where_its_pixels_end():
    """Each pixel is a square: the surface reaches half a pixel beyond their middles, a plane stays one."""
    column = np.arange(40.0)
    depth = np.tile(1.0 + 0.002 * column, (30, 1))
    depth[10:15, 20:25] += 0.2
    image = make_image(
        depth, 0.002, Camera(100.0, 100.0, 19.5, 14.5, depth.shape[1], depth.shape[0]), translation(0.0, 0.0, 1.0)
    )
    mask = np.zeros((30, 40), bool)
    mask[5:15, 10:20] = mask[10:15, 20:25] = True
    found, place, triangles = visible_surface(image, mask, np.full((30, 40), 0.03))
    assert place.min(axis=0).tolist() == [4.5, 9.5] and place.max(axis=0).tolist() == [14.5, 24.5]
    assert len(triangles) == 2 * mask.sum()
    plane = 1.0 + 0.002 * place[:, 1]
    off = found - plane
    assert np.allclose(np.minimum(np.abs(off), np.abs(off - 0.2)), 0.0)
    assert (np.abs(off[place[:, 1] < 19]) < 1e-9).all() and (off[place[:, 1] > 20] > 0.19).all()


def test_what_is_held_by_a_round_side_is_part_of_it():
    """A mallet that stands on its head: nothing else could hold its handle up."""
    turned = rotation_x(np.pi / 2)[:3, :3]
    head = make_row(CYLINDER, turned, np.array([0.0, 0.0, 0.03]), np.array([0.06, 0.06, 0.12]))
    handle = make_row(CYLINDER, np.eye(3), np.array([0.0, 0.0, 0.16]), np.array([0.03, 0.03, 0.2]))
    apart = handle.copy()
    apart[10] = 0.3
    lying = State().add(head, FREE, False)
    assert held_by_another(lying.add(handle, UPRIGHT, False)) == (1, 0)
    assert held_by_another(lying.add(apart, UPRIGHT, False)) is None  # it hangs over nothing
    box = make_row(BOX, np.eye(3), np.array([0.0, 0.0, 0.03]), np.array([0.1, 0.1, 0.06]))
    assert held_by_another(State().add(box, UPRIGHT, False, FLOOR, 0.0).add(handle, UPRIGHT, False)) is None
    tilted = make_row(BOX, rotation_x(0.2)[:3, :3], np.array([0.05, 0.0, 0.06]), np.array([0.06, 0.1, 0.1]))
    beside = State().add(tilted, FREE, False).add(head, FREE, False).add(handle, UPRIGHT, False)
    assert held_by_another(beside) == (2, 1)  # what bears it, and not what else it touches


def test_what_goes_on_straight_over_a_solid_is_its_part_and_what_stands_on_its_top_is_not():
    """The front of a solid, rows 10 to 19, seen from the front; above it a piece that is flush with it, or set back on
    its top, unseen or seen from above."""
    rows, columns = np.indices((20, 20)).astype(float)
    front = np.stack([0.002 * columns, np.full(rows.shape, 0.5), 0.002 * (20 - rows)], axis=-1)
    normal = np.broadcast_to([0.0, -1.0, 0.0], front.shape).copy()
    piece, solid = rows < 10, rows >= 10
    assert not goes_on(surface_through(front), piece, solid, normal)
    assert goes_on(surface_through(front), piece, solid, normal, flush=True)
    back = front.copy()
    back[piece, 1] += 0.008
    assert not goes_on(surface_through(back), piece, solid, normal, flush=True)
    unknown = np.zeros(front.shape)
    assert not goes_on(surface_through(front), piece, solid, unknown, flush=True)
    for concave, expected in ((6, True), (12, False)):  # columns: what noise makes of some, or a foot
        some = normal.copy()
        some[:10, :concave] = [0.0, -0.9, -0.43]
        assert goes_on(surface_through(front), piece, solid, some, flush=True) == expected


def test_a_narrow_cylinder_about_the_axis_of_a_wide_one_is_its_neck():
    def cylinder(x, bottom, across, height):
        return make_row(
            CYLINDER, np.eye(3), np.array([x, 0.0, bottom + 0.5 * height]), np.array([across, across, height])
        )

    body = State().add(cylinder(0.0, 0.0, 0.08, 0.15), UPRIGHT, False, FLOOR, 0.0)
    assert neck(body.add(cylinder(0.005, 0.15, 0.03, 0.04), UPRIGHT, False, 0, 0.15)) == (1, 0)
    assert neck(body.add(cylinder(0.025, 0.15, 0.03, 0.04), UPRIGHT, False, 0, 0.15)) is None  # off its axis
    assert neck(body.add(cylinder(0.005, 0.15, 0.07, 0.04), UPRIGHT, False, 0, 0.15)) is None  # a can on a can
    assert neck(body.add(cylinder(0.005, 0.15, 0.03, 0.16), UPRIGHT, False, 0, 0.15)) is None  # a cup on a bowl
    capped = body.add(cylinder(0.0, 0.15, 0.03, 0.04), UPRIGHT, False, 0, 0.15)
    assert neck(capped.add(cylinder(0.0, 0.19, 0.03, 0.04), UPRIGHT, False, 1, 0.19)) is None  # it bears another


def test_what_would_fall_off_what_alone_bears_it_is_a_part_of_it():
    """A cabinet on one of its feet, the others of which are hidden; not a lid that juts out."""
    foot = State().add(make_row(BOX, np.eye(3), [0.0, 0.0, 0.07], [0.05, 0.05, 0.14]), UPRIGHT, False, FLOOR, 0.0)
    for x, parts in ((0.15, (1, 0)), (0.01, None)):
        body = make_row(BOX, np.eye(3), [x, 0.0, 0.34], [0.4, 0.4, 0.4])
        assert neck(foot.add(body, UPRIGHT, False, 0, 0.14)) == parts


def test_what_stands_on_what_may_reach_under_it_unseen_is_no_part_of_it():
    """A board on a low box, its middle beyond what shows of that: behind the board nobody sees how deep the box is."""
    image = make_image(seen_on_the_table([]), np.full(CAMERA.shape, 0.001), CAMERA, TABLE, 0.0)
    low = State().add(make_row(BOX, np.eye(3), [0.0, 0.0, 0.03], [0.15, 0.1, 0.06]), UPRIGHT, False, FLOOR, 0.0)
    for beyond, wide, expected in ((0.08, 0.21, None), (-0.08, 0.21, (1, 0)), (0.08, 0.05, (1, 0))):
        board = make_row(BOX, np.eye(3), [0.0, beyond, 0.13], [wide, 0.045, 0.14])
        both = low.add(board, UPRIGHT, False, 0, 0.06)
        assert neck(both) == (1, 0)
        assert neck(both, image) == expected  # beside a narrow one the box would show
    can = make_row(CYLINDER, np.eye(3), [0.0, 0.0, 0.03], [0.1, 0.1, 0.06])
    behind = both.changed(0, row=can).changed(1, row=make_row(BOX, np.eye(3), [0.0, 0.08, 0.13], [0.21, 0.045, 0.14]))
    assert neck(behind, image) == (1, 0)  # what is round shows how deep it is


@pytest.mark.parametrize("deep, shape, expected", [(0.02, CYLINDER, (1, 0)), (0.06, CYLINDER, None), (0.02, BOX, None)])
def test_a_sheet_under_something_round_is_its_front(deep, shape, expected):
    """A pack of bottles was a cylinder on a box of 7 to 21 mm by 21 cm, which it would fall off."""
    image = make_image(seen_on_the_table([]), np.full(CAMERA.shape, 0.001), CAMERA, TABLE, 0.0)
    front = State().add(make_row(BOX, np.eye(3), [0.0, 0.0, 0.1], [0.2, deep, 0.2]), UPRIGHT, False, FLOOR, 0.0)
    above = make_row(shape, np.eye(3), [0.0, 0.1 - 0.5 * deep, 0.3], [0.2, 0.2, 0.2])
    assert neck(front.add(above, UPRIGHT, False, 0, 0.2), image) == expected
    lying = make_row(shape, rotation_x(np.pi / 2)[:3, :3], above[10:13], above[13:16])
    assert neck(front.add(lying, FREE, False, 0), image) == expected


def test_what_hangs_in_the_air_is_the_handle_of_what_it_goes_on_from():
    """A mug's handle, seen in few pixels: one that stands on the table is no handle."""
    tall = 0.1
    for height, expected in ((0.05, 0), (tall, None)):
        mug = trimesh.creation.cylinder(0.04, tall)
        handle = trimesh.creation.box([0.025, 0.012, height])
        handle.apply_translation([0.05, 0.0, 0.5 * (tall - height) - 0.005 * (height < tall)])
        whole = trimesh.util.concatenate([mug, handle])
        whole.apply_translation(-whole.bounds.mean(axis=0))
        size = whole.extents
        mesh = whole.vertices, np.ascontiguousarray(whole.faces, np.int32)
        seen = observe(seen_on_the_table([(MESH, 0.0, 0.0, tuple(size), mesh)]), CAMERA)
        place = np.linalg.inv(seen.floor.pose) @ TABLE
        centre = place[:3] @ [0.04 - 0.5 * size[0], 0.0, 0.5 * tall, 1.0]
        row = make_row(CYLINDER, np.eye(3), centre, np.array([0.08, 0.08, tall]))
        beside = seen.mask & (seen.points[..., 0] > centre[0] + 0.042)
        assert beside.sum() >= 8
        assert hangs_on(seen, State().add(row, UPRIGHT, False, FLOOR, 0.0), beside) == expected


def test_the_inside_of_what_a_solid_stood_for_is_part_of_the_thing_that_it_becomes():
    """The inside of a mug, told as a can and its handle, was explained by nothing once they were one; nor was a handle
    before it."""
    seen = observe(seen_on_the_table([(MESH, 0.0, 0.0, (0.14, 0.14, 0.06), bowl())]), CAMERA)
    centre = (np.linalg.inv(seen.floor.pose) @ TABLE)[:3, 3] + [0.0, 0.0, 0.03]
    can = State().add(make_row(CYLINDER, np.eye(3), centre, np.array([0.14, 0.14, 0.06])), UPRIGHT, False, FLOOR, 0.0)
    over = seen.mask & (seen.points[..., 2] > 0.01)
    assert hollow(seen, can) == (0,)
    _, (mask,) = joined_parts(seen, can, (0,))
    assert (mask & over).sum() > 0.97 * over.sum()
    full = observe(seen_on_the_table([(CYLINDER, 0.0, 0.0, (0.14, 0.14, 0.06), None)]), CAMERA)
    assert hollow(full, can) is None
    handle = trimesh.creation.box([0.02, 0.05, 0.04])
    handle.apply_translation([0.0, -0.08, 0.0])
    mug = trimesh.util.concatenate([trimesh.creation.cylinder(0.07, 0.06), handle])
    shift, mesh = mug.bounds.mean(axis=0), (mug.vertices, np.ascontiguousarray(mug.faces, np.int32))
    seen = observe(seen_on_the_table([(MESH, shift[0], shift[1], tuple(mug.extents), mesh)]), CAMERA)
    before = seen.mask & (seen.points[..., 1] < centre[1] - 0.075)
    _, (mask,) = joined_parts(seen, can, (0,))
    assert before.sum() > 20 and (mask & before).sum() > 0.8 * before.sum()


def test_a_gable_is_the_slope_of_its_carton_and_what_stands_on_one_is_not():
    wide, tall, high = 0.08, 0.12, 0.04
    carton = trimesh.creation.box([wide, wide, tall])
    ridge = [[0.5 * side * wide, 0.0, 0.5 * tall + high] for side in (-1, 1)]
    upper = trimesh.creation.box([0.5 * wide, 0.5 * wide, high])
    upper.apply_translation([0.0, 0.0, 0.5 * (tall + high)])
    gable = trimesh.convex.convex_hull(np.vstack([carton.vertices, ridge]))
    for whole, expected in ((gable, 0), (trimesh.util.concatenate([carton, upper]), None)):
        mesh = whole.vertices - whole.bounds.mean(axis=0), np.ascontiguousarray(whole.faces, np.int32)
        seen = observe(seen_on_the_table([(MESH, 0.0, 0.0, (wide, wide, tall + high), mesh)]), CAMERA)
        place = np.linalg.inv(seen.floor.pose) @ TABLE
        row = make_row(BOX, place[:3, :3], place[:3] @ [0.0, 0.0, 0.5 * tall, 1.0], np.array([wide, wide, tall]))
        state = State().add(row, UPRIGHT, False, FLOOR, 0.0)
        over = seen.mask & (seen.points[..., 2] > tall + 0.003)
        normal = seen.surface.normals(seen.surface.good)
        assert over.sum() > 50 and slope_of(seen, state, over, normal) == expected


def test_the_more_a_thing_explains_the_surer_it_is_an_object_but_never_sure():
    existence = bare_image().loose.existence  # as the built-in prior's file says
    told = np.array([existence.of(gain, 0.5) for gain in (0.0, 10.0, existence.even, 80.0, 1e4)])
    assert (np.diff(told[:, 0]) > 0.0).all() and told[-1, 0] <= 0.98
    assert told[2, 0] == pytest.approx(0.5 * existence.most) and told[2, 1] > told[-1, 1] > told[0, 1]


def test_what_a_surface_costs_does_not_speak_against_that_something_is_there():
    """A bowl's inside and rim cost so much that it was clutter, though all of it stood clear of a bare table."""
    scene = make(np.random.default_rng([7102, list(KINDS).index("free")]), "free")
    _, seen = point_estimate(np.random.default_rng(0), scene.depth, scene.camera)
    bowl_shows = scene.label == 2
    assert any((thing.mask & bowl_shows).sum() > 0.9 * bowl_shows.sum() for thing in seen.things)


def test_what_is_left_over_and_no_object_is_background():
    """It was nothing, so that a solid was put there later, at full price: a monitor's foot was a flat box."""
    seen = observe(seen_on_the_table([(BOX, 0.0, 0.0, (0.03, 0.03, 0.03), None)]), CAMERA)
    settings = Settings(temper=60.0)  # so much of what neighbours share that the box is likelier clutter
    seen, state, found, clutter = leftovers(np.random.default_rng(0), seen, State(), settings)
    assert len(state) == len(found) == 0
    seen, things = likely_things(seen, state, clutter, settings)
    assert not things and seen.behind[seen.mask].all()
    ((mask, probability),) = seen.clutter
    assert (mask & seen.behind).sum() == mask.sum() and 0.0 < probability < 0.5


def test_what_seems_to_be_a_seam_is_told_to_be_an_object_with_its_probability():
    """A rod two pixels thin was left over at P .5 and left out at .5, and nothing was said of it."""
    seen = observe(seen_on_the_table([(BOX, 0.0, 0.0, (0.12, 0.005, 0.016), None)]), CAMERA)._replace(correlation=0.9)
    seen, state, found, clutter = leftovers(np.random.default_rng(0), seen, State(), Settings(temper=60.0))
    assert len(state) + len(found) + len(clutter) == 0
    ((mask, probability),) = seen.clutter
    assert mask[seen.mask].all() and 0.1 < probability < 0.5


def test_the_inside_of_a_bowl_that_is_left_over_belongs_to_its_outside():
    """It did not pay its price as a thing, and so was a box, the bowl's inside, behind a thing, its front."""
    seen = observe(seen_on_the_table([(MESH, 0.0, 0.0, (0.14, 0.14, 0.07), bowl())]), CAMERA)
    seen = seen._replace(correlation=0.9, mask=seen.mask & (seen.points[..., 2] < 0.06))  # without its rim
    _, state, found, _ = leftovers(np.random.default_rng(0), seen, State(), Settings(temper=20.0))
    assert label_bodies(seen.points, seen.mask, seen.surface.jump)[1] == 2
    assert len(state) == 0 and [int(mask.sum()) for mask in found] == [int(seen.mask.sum())]


def test_two_that_touch_and_were_one_solid_are_two_solids_and_a_loaf_one_thing():
    """A search found one box over a box and half of the can beside it: both were one free-form thing, and trusted."""
    carton, can, ball = (0.08, 0.06, 0.1), (0.06, 0.06, 0.07), trimesh.creation.icosphere(4)
    loaf = ball.vertices, np.ascontiguousarray(ball.faces, np.int32)
    two = [(BOX, 0.0, 0.0, carton, None), (CYLINDER, 0.07, 0.0, can, None)]
    for shown, sizes in ((two, (carton, can)), ([(MESH, 0.03, 0.0, (0.18, 0.08, 0.1), loaf)], ())):
        seen = observe(seen_on_the_table(shown), CAMERA)._replace(correlation=0.9)
        place = np.linalg.inv(seen.floor.pose) @ TABLE
        row = make_row(BOX, place[:3, :3], place[:3] @ [0.015, 0.0, 0.05, 1.0], np.array([0.11, 0.06, 0.1]))
        before, settings = State().add(row, UPRIGHT, False, FLOOR, 0.0), Settings().for_pixels(60.0)
        _, state, found, _ = leftovers(np.random.default_rng(0), seen, before, settings)
        assert len(found) == (not sizes)
        for row, size in zip(sorted(state.rows.tolist(), key=lambda row: -row[15]), sizes, strict=True):
            assert row[13:16] == pytest.approx(size, abs=0.015)


def test_what_is_left_over_and_looks_as_a_solid_does_is_one_though_most_is_hidden():
    """A can behind another was clutter, for it hardly stands out: it was lost, and the answer was trusted."""
    cans = [(CYLINDER, 0.0, -0.05, (0.09, 0.09, 0.1), None), (CYLINDER, 0.02, 0.035, (0.07, 0.07, 0.09), None)]
    seen = observe(seen_on_the_table(cans), CAMERA)._replace(correlation=0.9)
    place = np.linalg.inv(seen.floor.pose) @ TABLE
    row = make_row(CYLINDER, place[:3, :3], place[:3] @ [0.0, -0.05, 0.05, 1.0], np.array([0.09, 0.09, 0.1]))
    before, settings = State().add(row, UPRIGHT, False, FLOOR, 0.0), Settings().for_pixels(15.0)
    hidden = seen.mask & (held_out(seen.image, before, -1)[2] > BAD)
    assert existence_of(seen, before, hidden, settings, np.zeros_like(hidden))[0] < 0.5
    _, state, found, clutter = leftovers(np.random.default_rng(0), seen, before, settings)
    assert len(state) == 2 and not found and not clutter
    assert state.rows[1, 13:16] == pytest.approx([0.07, 0.07, 0.09], abs=0.01)


def test_what_is_left_over_and_low_is_an_object_where_it_shows_clearly():
    """A rod of 14 mm on a bare table was left unexplained, and the answer trusted: it was below a limit for clutter."""
    seen = observe(seen_on_the_table([(BOX, 0.0, 0.0, (0.12, 0.03, 0.014), None)]), CAMERA)._replace(correlation=0.9)
    _, state, found, _ = leftovers(np.random.default_rng(0), seen, State(), Settings(temper=10.0))
    assert len(state) + len(found) == 1


def test_what_is_left_over_is_an_object_by_all_that_it_goes_on_into():
    """Of a torch on a bin's rough floor only a ridge was clearly over it, too little for an object."""
    image = seen_on_the_table([(BOX, 0.0, 0.0, (0.03, 0.03, 0.03), None), (BOX, 0.075, 0.0, (0.12, 0.03, 0.01), None)])
    seen = observe(image, CAMERA)
    seen = seen._replace(correlation=0.9, mask=seen.mask & (seen.points[..., 2] > 0.012))
    settings = Settings(temper=60.0)
    _, state, found, clutter = leftovers(np.random.default_rng(0), seen, State(), settings)
    assert len(state) == len(found) == 0 and len(clutter) == 1
    assert len(likely_things(seen, state, clutter, settings)[1]) == 1


def test_the_inside_of_a_mug_belongs_to_its_outside_but_a_second_mug_does_not():
    angle = np.linspace(0, np.pi, 60)
    ring = np.column_stack([0.04 * np.cos(angle), 0.04 * np.sin(angle)])
    rise = np.linspace(0.05, 0.1, 6)
    outside = np.array([[x, -y, z] for x, y in ring for z in rise])
    inside = np.array([[x, y, z] for x, y in ring for z in rise])
    camera = np.array([0.0, -0.6, 0.5])
    assert one_rim(outside, inside, camera)
    assert one_rim(3.0 * outside, 3.0 * inside, 3.0 * camera)  # a bucket
    handle = np.array([[x, 0.06 + y, 0.08] for x in np.linspace(-0.055, -0.03, 12) for y in np.linspace(0.0, 0.02, 8)])
    assert one_rim(outside, np.vstack([inside, handle]), camera)  # farther than its middle, but beside it
    small = 0.3 * inside + [0.0, 0.05, 0.07]
    assert not one_rim(outside, small, camera)  # something narrow as high as it, close behind it
    assert not one_rim(outside, outside + [0.09, 0.0, 0.0], camera)  # beside it
    assert not one_rim(outside, inside + [0.0, 0.1, 0.0], camera)  # behind it
    assert not one_rim(outside, outside + [0.0, 0.06, 0.0], camera)  # another one's outside, close behind it
    assert not one_rim(outside, inside + [0.0, 0.0, 0.05], camera)  # higher
    bowl, apart = [2.0, 2.0, 1.0], [0.0, 0.02, 0.0]
    assert one_rim(outside * bowl - apart, inside * bowl + apart, camera)  # its bottom is too low to be told
    assert not one_rim(outside * [1.0, 2.0, 1.0], inside * [1.0, 2.0, 1.0], camera)  # two, one behind the other
    crescent = outside[np.abs(outside[:, 0]) < 0.022] + [0.0, 0.02, 0.0]
    assert one_rim(crescent, inside, camera)  # a bowl tapers: of its outside less shows than of its inside
    assert not one_rim(crescent - [0.0, 0.0, 0.004], inside, camera)  # something lower before it
    deep = np.vstack([inside, handle - [0.03, -0.03, 0.0]])
    assert one_rim(outside, deep, camera)  # its handle shows behind it


def test_the_bottom_of_a_cup_is_no_object_beside_its_wall():
    """Small cups were objects at P .7, and one was not told: bottom and wall might have been two."""
    angle, spread = np.linspace(0, np.pi, 60), np.linspace(0.0, 0.035, 6)
    rise = np.linspace(0.05, 0.1, 6)
    outside, inside = (
        np.array([[0.04 * np.cos(a), way * 0.04 * np.sin(a), z] for a in angle for z in rise]) for way in (-1, 1)
    )
    bottom = np.array([[r * np.cos(a), r * np.sin(a), 0.02] for a in angle for r in spread])
    points = np.stack([outside, inside, bottom])
    surface = surface_through(points)._replace(origin=np.array([0.0, -0.6, 0.5]))
    label, area = np.repeat([[0], [1], [2]], outside.shape[0], axis=1), np.array([0.006, 0.006, 0.002])
    for beside, doubted in ((1, False), (0, True)):  # of the inside; of the outside it may be something before it
        edges = np.zeros((3, 3))
        edges[beside, 2] = edges[2, beside] = 0.05
        owner, least = joined(surface, label, edges, 47.0, 23.0 / 0.03, area, Things())
        assert len(np.unique(owner)) == 1 and np.isfinite(least[owner[0]]) == doubted


def test_a_piece_that_goes_on_across_a_convex_edge_is_no_object_and_one_in_a_corner_is():
    step = np.arange(40) * 0.002
    flat = np.stack(np.meshgrid(step, step), axis=-1)
    mask = np.zeros((40, 40), bool)
    mask[:20] = True
    # a roof's two slopes, a gutter's, and what noise makes of a flat
    for steep, expected in ((-1.0, True), (1.0, False), (-0.03, False)):
        height = steep * np.abs(flat[..., 1] - step[20])
        points = np.dstack([flat, height])
        slope = np.where(mask, -steep, steep)
        normal = np.dstack([np.zeros((40, 40)), -slope, np.ones((40, 40))]) / np.hypot(1.0, steep)
        assert goes_on(surface_through(points), mask, ~mask, normal) == expected


def test_an_axis_is_that_of_what_was_turned_and_a_box_has_none():
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(-2.0, 1.0, 400), rng.uniform(0.0, 0.2, 400)
    radius, slope = 0.05 - 0.1 * height, -0.1
    way = np.column_stack([np.cos(angle), np.sin(angle)])
    points = np.column_stack([[0.3, -0.1] + radius[:, None] * way, height])
    normal = np.column_stack([way, np.full(400, -slope)]) / np.hypot(1.0, slope)
    centre, widest = vertical_axis(points + 5e-4 * rng.standard_normal(points.shape), normal)
    assert np.allclose(centre, [0.3, -0.1], atol=0.002) and widest == pytest.approx(0.05, abs=0.002)
    assert vertical_axis(points[:10], normal[:10]) is None  # too few
    seen = points[height > 0.02]  # noise hides where it meets the table
    assert foot_radius(seen, centre, 0.0) == pytest.approx(0.05, abs=0.003)
    assert foot_radius(seen * [1.0, 1.0, -1.0], centre, -0.2) == 0.0  # it widens upwards
    along = rng.uniform(-0.05, 0.05, 400)
    first = np.arange(400) < 200
    box = np.column_stack([np.where(first, along, 0.05), np.where(first, 0.05, along), height])
    sides = np.column_stack([~first, first, np.zeros(400)]).astype(float)
    assert vertical_axis(box, sides) is None
    assert vertical_axis(box[first], sides[first]) is None  # one face tells no axis


def test_a_box_that_could_not_stand_is_the_face_of_something_else():
    def alone(turn, size, height, form, *others):
        row = make_row(BOX, turn[:3, :3], [0.0, 0.0, height], size)
        rows, n = np.array([row, *others]), 1 + len(others)
        return falling(State(rows, [form, UPRIGHT][:n], [False] * n, [FLOOR] * n, [np.nan] * n))

    upright = rotation_x(0.0)
    assert alone(upright, [0.005, 0.09, 0.06], 0.03, UPRIGHT) == (0,)
    assert alone(upright, [0.03, 0.09, 0.06], 0.03, UPRIGHT) is None
    beside = make_row(BOX, np.eye(3), [0.045, 0.0, 0.04], [0.08, 0.08, 0.08])
    assert alone(upright, [0.005, 0.09, 0.06], 0.03, UPRIGHT, beside) is None
    tilted = rotation_x(0.6)
    low = 0.5 * (0.1 * np.sin(0.6) + 0.01 * np.cos(0.6))
    assert alone(tilted, [0.1, 0.1, 0.01], low, FREE) == (0,)
    assert alone(tilted, [0.1, 0.1, 0.04], low, FREE) == (0,)  # sunk in the floor


def test_a_ball_sunk_in_what_it_stands_on_is_the_dome_of_something_else():
    box = make_row(BOX, np.eye(3), [0.0, 0.0, 0.05], [0.2, 0.2, 0.1])

    def found(height, rows=()):
        ball = make_row(SPHERE, np.eye(3), [0.0, 0.0, height], [0.1, 0.1, 0.1])
        count = 1 + len(rows)
        return falling(State([ball, *rows], [FREE] * count, [False] * count, [FLOOR] * count, [np.nan] * count))

    assert found(0.05) is None and found(0.04) is None
    assert found(0.02) == (0,)
    assert found(0.15, [box]) is None and found(0.12, [box]) == (0,)


def test_what_is_ragged_or_hidden_stands_out_less():
    image = seen_on_the_table([(BOX, 0.0, 0.0, (0.12, 0.12, 0.1), None)])
    seen = observe(image, CAMERA)
    nothing = np.zeros(seen.mask.shape, bool)
    whole = outstanding(seen, seen.mask, nothing)
    rows, columns = np.indices(seen.mask.shape)
    assert whole > 0.8
    striped = seen.mask & ((rows + columns) % 4 < 2)
    assert outstanding(seen._replace(mask=striped), striped, nothing) < 0.7 * whole
    left = seen.mask & (columns < np.median(columns[seen.mask]))
    assert outstanding(seen, left, nothing) < 0.9 * whole  # goes on as what stands there too
    assert outstanding(seen, left, seen.mask & ~left) > outstanding(seen, left, nothing)  # which it may stand on
    beside = np.roll(seen.mask, 8, axis=1) & ~seen.mask & (columns > np.median(columns[seen.mask]))
    weight = np.where(beside, 0.0, seen.image.weight)  # the shadow that it casts for the other of two cameras
    shadowed = outstanding(seen._replace(image=seen.image._replace(weight=weight)), seen.mask, nothing)
    assert 0.8 * whole < shadowed < 0.95 * whole


def test_a_small_box_on_another_is_found_in_what_a_phone_sees():
    """Smoothed, with noise that neighbours share: too few pixels for the search, and joined to what it stands on."""
    scene = make(np.random.default_rng([103, list(KINDS).index("phone")]), "phone")
    state, seen = point_estimate(np.random.default_rng(0), scene.depth, scene.camera)
    assert seen.image.taps.size > 2  # the blur is told
    small = np.array(scene.objects[2]["size"])
    (k,) = (k for k in range(len(state)) if state.parents[k] >= 0)
    assert np.prod(state.rows[k][13:16]) == pytest.approx(np.prod(small), rel=0.5)


def test_a_small_thing_on_a_box_is_no_part_of_it_where_its_outline_is_smeared():
    """Its silhouette goes over into the top behind it as a convex edge would."""
    scene = make(np.random.default_rng([302, list(KINDS).index("phone")]), "phone")
    state, seen = point_estimate(np.random.default_rng(0), scene.depth, scene.camera)
    rows = [row for row, parent in zip(state.rows, state.parents, strict=True) if parent >= 0]
    (small,) = [*rows, *(thing.row for thing in seen.things if thing.parent >= 0)]  # a box, or as it is seen
    assert len(state) + len(seen.things) == 3
    assert np.prod(small[13:16]) == pytest.approx(np.prod(scene.objects[2]["size"]), rel=0.5)


@pytest.mark.parametrize("number", [105, 108])
def test_what_a_thing_goes_on_as_is_part_of_it(number):
    """A bottle is no can with a cork, an L and a mug with its handle no solids with clutter beside them."""
    scene = make(np.random.default_rng([number, list(KINDS).index("free")]), "free")
    _, seen = point_estimate(np.random.default_rng(0), scene.depth, scene.camera)
    assert len(seen.things) == len(scene.free) == 2
    for k in scene.free:
        thing = max(seen.things, key=lambda each: (each.mask & (scene.label == k)).sum())
        said, true = thing.row[13:16], np.asarray(scene.objects[k]["size"])
        assert np.sort(said[:2]) == pytest.approx(np.sort(true[:2]), rel=0.1)
        assert said[2] == pytest.approx(true[2], rel=0.1)


@pytest.mark.parametrize(
    "number, k", [(7204, 2), (7205, 0), (7217, 2), (7208, 4), (7219, 2), (7214, 0), (7250, 2), (7247, 2)]
)
def test_a_wedge_ends_where_its_slope_meets_the_floor_and_an_l_where_it_is_seen_to(number, k):
    """The lowest millimetres of a slope are noise of the floor; some pixel shows nearly the end of an edge; an L is not
    round, and a mug is but for its handle."""
    scene = make(np.random.default_rng([number, list(KINDS).index("free")]), "free")
    seen = observe(scene.depth, scene.camera, widest=320)
    thing = made_thing(seen, State(), (scene.label == k) & seen.mask, 1.0)
    said, true = thing.row[13:16], np.asarray(scene.objects[k]["size"])
    assert np.sort(said[:2]) == pytest.approx(np.sort(true[:2]), rel=0.1)
    assert said[2] == pytest.approx(true[2], rel=0.1)


def test_the_edges_of_what_a_blurred_image_shows_are_not_its_surface():
    mask = np.zeros((20, 20), bool)
    mask[4:16, 4:16] = True
    for blur, reach in ((0.0, 0), (0.6, 1), (1.0, 2)):
        clear, found = clear_of_edges(SimpleNamespace(image=SimpleNamespace(taps=taps_of(blur))), mask)
        assert found == reach and clear.sum() == (12 - 2 * reach) ** 2
    narrow = mask & (np.arange(20) < 6)
    assert clear_of_edges(SimpleNamespace(image=SimpleNamespace(taps=taps_of(1.0))), narrow)[0].sum() == 24


def test_what_shows_its_front_alone_is_as_deep_as_such_things_usually_are():
    across, up = np.meshgrid(np.linspace(-0.05, 0.05, 30), np.linspace(0.1, 0.0, 30))
    points = np.dstack([across, np.full((30, 30), 0.5), up])
    mask, origin = np.ones((30, 30), bool), np.array([0.0, -0.4, 0.5])
    surface = SeenSurface.of(points, mask, np.full((30, 30), 0.003), np.full((30, 30), 0.001), origin)
    seen = SimpleNamespace(points=points, footprint=surface.footprint, sigma=0.001 * mask, surface=surface,
                           image=SimpleNamespace(origin=origin, taps=np.ones(1)), no_floor=False)  # fmt: skip
    thing = made_thing(seen, State(), mask, 50.0)
    row = thing.row
    turn, size = np.abs(row[1:10].reshape(3, 3)), row[13:16]
    assert turn @ size == pytest.approx([0.103, 0.7 * np.sqrt(0.103 * 0.1), 0.1], abs=0.004)
    assert row[11] - 0.5 * (turn @ size)[1] == pytest.approx(0.5, abs=0.003)  # and all of that is behind
    # Half as deep, or as deep again, is as likely as not: that is a guess, of which only what is seen is sure.
    assert thing.guessed.max() == pytest.approx(0.7 * np.sqrt(0.103 * 0.1), abs=0.006)
    points[..., 1] += 0.8 * up  # a slope shows how deep it is
    thing = made_thing(seen, State(), mask, 50.0)
    assert thing.row[13:16].max() < 0.12 and not thing.guessed.any()


def test_a_small_box_on_another_is_a_box_where_pixels_count_for_fewer():
    """180 pixels of a phone are worth four: that something is there is sure, and that a box shows as it does."""
    seen = make(np.random.default_rng([1201, list(KINDS).index("phone")]), "phone")
    state, observed = point_estimate(np.random.default_rng(0), seen.depth, seen.camera)
    assert not observed.things
    assert sorted(int(row[0]) for row in state.rows) == [BOX, BOX, SPHERE]


def test_a_sensor_image_stays_one_where_fewer_columns_do_not_show_what_noise_its_floor_has(monkeypatch):
    image = seen_on_the_table([(BOX, 0.0, 0.0, (0.09, 0.07, 0.12), None)])
    looks = []

    def look(*arguments, **others):
        looks.append(observe(*arguments, **others)._replace(correlation=0.1 if looks else 0.5))
        return looks[-1]

    monkeypatch.setattr(estimate, "observe", look)
    monkeypatch.setattr(estimate, "width_wanted", lambda seen: 80)
    _, seen = point_estimate(np.random.default_rng(0), image, CAMERA, Settings(tries=1))
    assert len(looks) == 2
    assert seen.correlation == 0.5


def test_a_bowl_is_all_that_goes_on_beyond_the_ball_that_is_as_round():
    """Of a bowl a ball that sinks into the floor explained most, and without its rim it was no object (P .26)."""
    seen = observe(seen_on_the_table([(MESH, 0.0, 0.0, (0.09, 0.09, 0.06), bowl(0.045))]), CAMERA)
    x, y, _ = np.median(seen.points[seen.mask], axis=0)
    state = State().add(make_row(SPHERE, np.eye(3), [x, y, 0.03], np.full(3, 0.09)), UPRIGHT, False)
    assert falling(state) == (0,)
    left, (mask,) = joined_parts(seen, state, (0,))
    assert len(left) == 0 and (mask & seen.mask).sum() > 0.97 * seen.mask.sum()
