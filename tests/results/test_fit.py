"""How well a scene fits its image: on scenes whose every pixel is known."""

import imageio.v3 as imageio
import numpy as np
import pytest
from on_floor import cube, on_floor

from derender.camera.image_files import png_bytes
from derender.camera.intrinsics import Camera
from derender.results.fit import MOST_TOLERANCE, fit_of, flat_noise, median
from derender.scene.graph import Vertex

CAMERA = Camera.from_field_of_view(96, 72)
WALL = 3.0


@pytest.fixture
def graph():
    """A cube of 20 cm on a floor of 1 m, looked at from straight above; a frame between them that shows nowhere."""
    return on_floor(Vertex("frame", "frame"), cube(side=0.2))


def image(graph, sigma=0.001):
    depth = fit_of(graph, CAMERA, np.ones(CAMERA.shape), {}).depth.astype(float)
    return depth + np.random.default_rng(0).normal(0.0, sigma, depth.shape)


def test_labels_count_the_objects_as_show_does(graph):
    fit = fit_of(graph, CAMERA, image(graph), {})
    assert set(np.unique(fit.label)) == {0, 3}  # the cube is the third object; floor and frame are none
    np.testing.assert_array_equal(fit.label == 3, np.isclose(fit.depth, 0.8))
    assert fit.label.dtype == np.uint16 and fit.depth.dtype == np.float32


def test_16_bits_are_written_high_byte_first():
    label = np.arange(0, 60000, 997, dtype=np.uint16).reshape(-1, 1) * np.ones((1, 3), np.uint16)
    np.testing.assert_array_equal(imageio.imread(png_bytes(label)), label)


def test_noise_is_explained_and_what_is_not_there_is_not(graph):
    seen = image(graph)
    assert fit_of(graph, CAMERA, seen, {}).share > 0.999
    seen[10:20, 10:20] = 0.9
    seen[60:, :] = np.nan
    fit = fit_of(graph, CAMERA, seen, {})
    assert not fit.explained[10:20, 10:20].any() and not fit.explained[60:].any()
    assert fit.share == pytest.approx(1.0 - 100 / (60 * 96), abs=1e-3)


def test_a_silhouette_may_lie_a_pixel_aside(graph):
    """Depths between those of the cube and of the floor are a blurred edge's; they are explained nowhere else."""
    seen, label = image(graph), fit_of(graph, CAMERA, image(graph), {}).label
    rows, columns = np.nonzero(label)
    edge = rows.min() - 1, columns.mean().astype(int)
    seen[edge] = 0.9
    assert fit_of(graph, CAMERA, seen, {}).explained[edge]
    seen[edge[0] - 6, edge[1]] = 0.9
    assert not fit_of(graph, CAMERA, seen, {}).explained[edge[0] - 6, edge[1]]


def test_background_is_taken_as_seen_but_never_where_a_solid_would_hide_it(graph):
    seen = image(graph)
    cube = fit_of(graph, CAMERA, seen, {}).label == 3
    seen[10:20, 10:20] = 0.5
    told = seen.copy()
    seen[cube] = told[cube] = 1.2
    fit = fit_of(graph, CAMERA, seen, {}, told=told)
    assert fit.background[10:20, 10:20].all() and fit.background.sum() < 130 and not fit.background[cube].any()
    assert not fit.explained[10:20, 10:20].any() and np.allclose(fit.depth[10:20, 10:20], 0.5)


def test_what_lies_before_a_solid_hides_it_and_a_bend_does_not(graph):
    seen = image(graph)
    cube = fit_of(graph, CAMERA, seen, {}).label == 3
    nearer = seen.copy()
    nearer[cube] = 0.5
    fit = fit_of(graph, CAMERA, nearer, {}, told=nearer)
    assert fit.background[cube].all() and not (fit.label[cube] == 3).any()
    bent = np.where(cube, 0.97 * seen, seen)
    assert not fit_of(graph, CAMERA, bent, {}).explained[cube].all()
    fit = fit_of(graph, CAMERA, bent, {}, told=bent)
    assert fit.explained[cube].all() and (fit.label[cube] == 3).all()


def test_the_wall_of_the_likelihood_is_explained(graph):
    lone = graph.remove("red").remove("frame").remove("floor")
    seen = np.full(CAMERA.shape, WALL)
    assert fit_of(lone, CAMERA, seen, {}).share == 0.0
    assert np.isnan(fit_of(lone, CAMERA, seen, {}).depth).all()
    assert fit_of(lone, CAMERA, seen, {"background": WALL, "blur": 1.0}).share == 1.0


def test_no_noise_swallows_a_solid(graph):
    """Whatever the image's noise, a depth that is far off is not explained."""
    seen = image(graph.remove("red"), 0.1)
    fit = fit_of(graph, CAMERA, seen, {})
    assert (fit.tolerance <= MOST_TOLERANCE * seen + 1e-12).all()
    assert fit.share < 0.5


@pytest.mark.parametrize("sigma, growth", [(0.0, 0.0), (0.002, 0.0), (0.0005, 0.002)])
def test_flat_patches_show_the_noise(sigma, growth):
    """A slanted plane from .7 to 2 m with a box on it: the noise is found, nothing of the slant or of the edges."""
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:120, :160]
    depth = 1.0 / (0.5 + 0.008 * rows + 0.0002 * columns)
    depth[40:70, 60:100] -= 0.1
    spread = sigma + growth * depth**2
    noise = flat_noise(depth + spread * rng.standard_normal(depth.shape))
    assert noise.sigma == pytest.approx(np.median(spread), rel=0.25, abs=1e-6)
    ends = np.array([0.75, 1.6])
    assert noise.at(ends) == pytest.approx(sigma + growth * ends**2, rel=0.35, abs=1e-6)
    assert flat_noise(np.full((20, 20), np.nan)).sigma == 0.0


def test_what_lies_flat_on_a_floor_seen_at_a_slant_is_that_floor():
    """Eight millimetres over it, which are over twenty along a ray that meets it at twenty degrees."""
    low = on_floor(elevation=20.0, distance=1.2)
    bare = fit_of(low, CAMERA, np.ones(CAMERA.shape), {}).depth.astype(float)
    height = np.abs(CAMERA.rays() @ low.poses()["floor"][:3, 2])
    for over, share in ((0.008, 1.0), (0.05, 0.0)):
        part = (bare > 0.9) & (bare < 1.5)
        seen = np.where(part, bare - over / height, np.nan)
        assert fit_of(low, CAMERA, seen, {}).explained[part].mean() == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("count", [1, 2, 3, 10, 501])
def test_the_median_is_numpys(count):
    values = np.random.default_rng(count).normal(size=count).round(1)
    assert median(values) == np.median(values)
