"""The antialiased image against many rays a pixel, and its derivatives against its differences."""

import numpy as np
import pytest
from exact_rows import exact_derivative
from gradient_check import (
    BACKGROUND,
    BLUR,
    CAMERA,
    LINES_STEP,
    RAYS_STEP,
    cast_differences,
    moved,
    own_error,
    random_motion,
    random_scene,
    share,
)
from scipy.ndimage import gaussian_filter
from smooth_image import SmoothLikelihood, antialiased_depth, derivative_image

from derender.render.blur import blur, blur_into, blur_taps
from derender.render.raycast.antialias import draw_antialiased
from derender.render.raycast.canvas import new_canvas
from derender.render.raycast.depth import render_depth
from derender.render.raycast.normal_equations import MOTION
from derender.scene.solids import BOX, CYLINDER, SPHERE, Solids


def one_moving(solids: Solids, seed: int = 0):
    """Return the solids, a motion of the first after the plane, and how many metres there are a pixel."""
    return solids, random_motion(solids, 1, seed), solids.pose[1, 2, 3] / CAMERA.fx


WINDOW = np.array([0, 64, 0, 64])


def own_errors(kind: int, scenes: int = 12, **settings) -> list[float]:
    return [own_error(kind, seed, **settings) for seed in range(scenes)]


@pytest.mark.parametrize(("kind", "most"), [(BOX, 0.01), (SPHERE, 0.03), (CYLINDER, 0.1)])
def test_derivative_of_the_image(kind, most):
    """A per cent of its norm in the middle, for boxes in every scene. Where chords of two curved outlines meet one of
    them jumps now and then."""
    found = own_errors(kind)
    assert np.median(found) < 0.01
    assert max(found) < most


@pytest.mark.parametrize(("kind", "most"), [(BOX, 0.02), (SPHERE, 0.07), (CYLINDER, 0.05)])
def test_antialiased_image(kind, most):
    """The mean over pixels' areas: as good as the 32 x 32 rays that it is compared with, and better than 4 x 4."""
    for seed in range(5):
        solids = random_scene(seed, kind, stacked=seed % 2 == 1 and kind == BOX)
        reference, grid, one = (render_depth(solids, CAMERA, antialias=n, background=BACKGROUND)[0] for n in (32, 4, 1))
        away = np.linalg.norm(antialiased_depth(solids, CAMERA, BACKGROUND) - reference)
        assert away < most * np.linalg.norm(one - reference)
        assert away < np.linalg.norm(grid - reference)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [BOX, SPHERE, CYLINDER])
def test_derivative_against_exact_lines(kind):
    """Differences of an image that another way of integrating makes: 1 % in every scene."""
    for seed in (0, 1):
        solids = random_scene(seed, kind, stacked=seed % 2 == 1 and kind == BOX)
        motion, pixel = random_motion(solids, 1, seed), solids.pose[1, 2, 3] / CAMERA.fx

        def scene(h, solids=solids, motion=motion):
            return moved(solids, 1, motion, h)

        reference = blur(exact_derivative(scene, CAMERA, BACKGROUND, LINES_STEP * pixel, 64), BLUR)
        assert share(derivative_image(solids, CAMERA, 1, motion, BACKGROUND, BLUR), reference) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("kind", [BOX, SPHERE, CYLINDER])
def test_derivative_against_supersampled_images(kind):
    """Central differences of images of 16 x 16 rays a pixel, the mean over 16 places of their grid: 1 % of the norm."""
    solids, motion, pixel = one_moving(random_scene(1, kind), 1)
    exact = derivative_image(solids, CAMERA, 1, motion, BACKGROUND, BLUR)
    differences, _ = cast_differences(lambda h: moved(solids, 1, motion, h), RAYS_STEP * pixel, 16)
    assert share(exact, differences) < 0.01
    without = derivative_image(solids, CAMERA, 1, motion, BACKGROUND, BLUR, edges=False)
    assert share(without, differences) > 0.3


def test_areas_add_up():
    """Every pixel's parts make a pixel, and the borders of a piece inside and outside an outline are as long."""
    for kind in (BOX, SPHERE, CYLINDER):
        solids = random_scene(1, kind, stacked=kind == BOX)
        canvas = new_canvas(CAMERA, 5)
        draw_antialiased(canvas, solids.kind, solids.pose, solids.size, BACKGROUND, WINDOW)
        mixed = np.flatnonzero(canvas.mixed)
        shares = np.array([canvas.parts[slice(*canvas.part_range[pixel]), 0].sum() for pixel in mixed])
        assert len(mixed) > 100
        # the chords of a curved outline leave out, or take in, a hundredth of a pixel
        assert np.all(np.abs(shares - 1.0) < (1e-9 if kind == BOX else 0.02))
        length = np.linalg.norm(np.diff(canvas.borders.reshape(-1, 2, 2), axis=1)[:, 0], axis=1)
        edge, end = canvas.border_code[:, 0], canvas.used[1]
        inner, outer = (length[:end][edge[:end] & 1 == side].sum() for side in (0, 1))
        assert np.isclose(inner, outer, rtol=1e-9)


@pytest.mark.parametrize("kind", [BOX, SPHERE, CYLINDER])
def test_only_what_changed_is_drawn_again(kind):
    """Forty moves of one solid after another: image, cost and derivative equal those made from nothing, bit for bit."""
    rng, solids = np.random.default_rng(0), random_scene(2, kind)
    observed = antialiased_depth(solids, CAMERA, BACKGROUND, BLUR) + rng.normal(0, 0.02, (64, 64))
    motions = np.zeros((MOTION, 5, MOTION))
    again = SmoothLikelihood(CAMERA, observed, solids.kind, 0.01, BLUR, parameters=MOTION)
    drawn = []
    for n in range(40):
        k = 1 + n % 4
        solids = moved(solids, k, random_motion(solids, k, n), rng.normal(0, 0.01))
        motions[:, :] = 0.0
        motions[np.arange(MOTION), k, np.arange(MOTION)] = 1.0
        anew = SmoothLikelihood(CAMERA, observed, solids.kind, 0.01, BLUR, parameters=MOTION)
        found = [likelihood.equations(solids.pose, solids.size, motions) for likelihood in (again, anew)]
        assert found[0][0] == found[1][0]
        assert np.array_equal(again.misfit.canvas.depth, anew.misfit.canvas.depth)
        for first, second in zip(*found, strict=True):
            assert np.array_equal(first, second)
        left, right, top, bottom = again.misfit.canvas.dirty
        drawn.append((right - left) * (bottom - top))
    assert drawn[0] == 64 * 64
    assert np.median(drawn) < 64 * 64 / 4


def test_without_occlusion_edges_it_is_wrong():
    """The broken twin: the derivative inside silhouettes alone."""
    assert np.median(own_errors(BOX, 6, edges=False)) > 0.3


def test_blur_of_a_part_is_that_of_the_whole_and_scipys():
    """Of an image's corner, and of its middle."""
    image = np.random.default_rng(0).normal(size=(9, 12))
    assert np.allclose(blur(image, 1.3), gaussian_filter(image, 1.3, mode="nearest", radius=4), atol=1e-14)
    for i0, i1, j0, j1 in ((0, 5, 0, 3), (4, 9, 2, 8)):
        blurred = np.empty((j1 - j0, i1 - i0))
        blur_into(blur_taps(1.3), image, i0, i1, j0, j1, blurred)
        assert np.allclose(blurred, blur(image, 1.3)[j0:j1, i0:i1], atol=1e-14)


def test_normal_equations_are_sums_over_pixels():
    """Cost, gradient and Gauss-Newton matrix from the Jacobian images, missing pixels left out."""
    solids = random_scene(3, BOX, stacked=True)
    rng = np.random.default_rng(0)
    observed = antialiased_depth(solids, CAMERA, BACKGROUND, BLUR) + rng.normal(0, 0.02, (64, 64))
    observed[10:20, 5:30] = np.nan
    likelihood = SmoothLikelihood(CAMERA, observed, solids.kind, 0.01, BLUR, BACKGROUND, parameters=MOTION)
    motions = np.zeros((MOTION, 5, MOTION))
    motions[np.arange(MOTION), 2, np.arange(MOTION)] = 1.0
    value, gradient, hessian = likelihood.equations(solids.pose, solids.size, motions)
    seen = np.isfinite(observed)
    residual = (antialiased_depth(solids, CAMERA, BACKGROUND, BLUR) - observed)[seen] / 0.01
    jacobian = np.array([derivative_image(solids, CAMERA, 2, motion[2], BACKGROUND, BLUR)[seen] for motion in motions])
    jacobian /= 0.01
    assert np.isclose(value, 0.5 * np.sum(residual**2), rtol=1e-12)
    assert np.allclose(gradient, jacobian @ residual, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())
    assert np.allclose(hessian, jacobian @ jacobian.T, rtol=1e-9, atol=1e-9 * np.abs(hessian).max())
    expected = -np.sum(0.5 * residual**2 + np.log(0.01 * np.sqrt(2 * np.pi)))
    assert np.isclose(likelihood.log_likelihood(solids), expected, rtol=1e-12)
