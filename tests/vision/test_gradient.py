"""Derivatives of the antialiased image against differences of one that is supersampled 16 x 16 and more."""

import numpy as np
import pytest

from derender.model.pose import rotation_x, rotation_z, translation, twist_exp
from derender.model.solids import BOX, CYLINDER, PLANE, SPHERE, Solids
from derender.vision.blur import blur, blur_taps
from derender.vision.camera import Camera
from derender.vision.gradient import SmoothLikelihood, antialiased_depth
from derender.vision.raycast.antialias import draw_antialiased
from derender.vision.raycast.canvas import new_canvas
from derender.vision.raycast.depth import render_depth
from derender.vision.raycast.records import MOTION, new_records, spread
from derender.vision.raycast.sensitivity import record
from derender.vision.raycast.smooth import blur_adjoint, blur_rectangle

CAMERA = Camera.from_field_of_view(64, 64)
WINDOW = np.array([0, 64, 0, 64])
BACKGROUND, BLUR = 10.0, 1.0


def scene(seed: int, kind: int = BOX, stacked: bool = False) -> Solids:
    """A plane and four solids, scattered or in a stack; the camera looks down, so no horizon is seen."""
    rng = np.random.default_rng(seed)
    root = translation(0, 0.05, 0.9) @ rotation_x(np.pi / 2 + rng.uniform(0.7, 1.1))
    poses, sizes = [root], [np.zeros(3)]
    for i in range(4):
        size = rng.uniform(0.06, 0.14, 3)
        size[1] = size[0] if kind != BOX else size[1]
        size[2] = size[0] if kind == SPHERE else size[2]
        on_top = stacked and i > 0
        base, lift = (poses[-1], sizes[-1][2] / 2) if on_top else (root, 0.0)
        x, y = rng.uniform(-0.3, 0.3, 2) * sizes[-1][:2] if on_top else rng.uniform(-0.2, 0.2, 2)
        poses.append(base @ translation(x, y, lift + size[2] / 2) @ rotation_z(rng.uniform(0, 7)))
        sizes.append(size)
    kinds = np.array([PLANE, *[kind] * 4], np.int32)
    return Solids(kinds, np.array(poses), np.array(sizes), np.full(5, -1, np.int32))


def motion_of(solids: Solids, k: int, seed: int) -> np.ndarray:
    """A random motion of solid k with turns about its own centre and, keeping it what it is, growth."""
    rng = np.random.default_rng([seed, 7])
    motion = rng.normal(size=MOTION)
    motion[3:6] /= 0.08  # as much movement at a surface from turning as from shifting
    motion[:3] -= np.cross(motion[3:6], solids.pose[k, :3, 3])
    if solids.kind[k] != BOX:
        motion[7] = motion[6]
    if solids.kind[k] == SPHERE:
        motion[8] = motion[6]
    return motion


def moved(solids: Solids, k: int, motion: np.ndarray, step: float) -> Solids:
    pose, size = solids.pose.copy(), solids.size.copy()
    pose[k] = twist_exp(step * motion[:3], step * motion[3:6]) @ pose[k]
    size[k] += step * motion[6:]
    return solids._replace(pose=pose, size=size)


def differences(solids: Solids, k: int, motion: np.ndarray, step: float, supersampling: int = 32) -> np.ndarray:
    """Fourth-order central differences of the blurred supersampled image."""

    def image(h):
        shown, _ = render_depth(moved(solids, k, motion, h), CAMERA, antialias=supersampling, background=BACKGROUND)
        return blur(shown, BLUR)

    return (8 * (image(step) - image(-step)) - (image(2 * step) - image(-2 * step))) / (12 * step)


def jacobian(solids: Solids, k: int, motion: np.ndarray, edges: bool = True) -> np.ndarray:
    canvas, records = new_canvas(CAMERA, 5), new_records(CAMERA, 5)
    draw_antialiased(canvas, solids.kind, solids.pose, solids.size, BACKGROUND, WINDOW)
    record(canvas, records, solids.kind, solids.pose, solids.size, np.ones(5, bool), BACKGROUND, WINDOW, edges)
    motions = np.zeros((1, 5, MOTION))
    motions[0, k] = motion
    images = np.zeros((1, 64 * 64))
    spread(records, motions, np.any(motions != 0, axis=2), images)
    return blur(images[0].reshape(64, 64), BLUR)


def errors(kind: int, edges: bool = True) -> list[float]:
    found = []
    for seed in range(6):
        solids = scene(seed, kind, stacked=seed % 2 == 1 and kind == BOX)
        k = 1 + seed % 4
        motion = motion_of(solids, k, seed)
        pixel = solids.pose[k, 2, 3] / CAMERA.fx
        reference = differences(solids, k, motion, 0.05 * pixel)
        found.append(np.linalg.norm(jacobian(solids, k, motion, edges) - reference) / np.linalg.norm(reference))
    return found


@pytest.mark.parametrize(("kind", "median"), [(BOX, 0.03), (SPHERE, 0.06), (CYLINDER, 0.07)])
def test_derivative_of_the_image(kind, median):
    """The reference itself moves by about 1 % between steps of .03 and .06 pixels (32 rays a pixel side: an edge's
    place is known to 1/32 / sqrt(12) of a pixel a ray row, over steps of a tenth of a pixel)."""
    assert np.median(errors(kind)) < median


def test_without_occlusion_edges_it_is_wrong():
    """The broken twin: the derivative inside silhouettes alone."""
    assert np.median(errors(BOX, edges=False)) > 0.3


def test_antialiased_image():
    """The mean over pixels' areas: nearer to 32 x 32 rays than a grid of 4 x 4 is, in every scene of boxes."""
    for seed in range(5):
        solids = scene(seed, BOX, stacked=seed % 2 == 1)
        reference, _ = render_depth(solids, CAMERA, antialias=32, background=BACKGROUND)
        grid, _ = render_depth(solids, CAMERA, antialias=4, background=BACKGROUND)
        ours = antialiased_depth(solids, CAMERA, BACKGROUND)
        assert np.linalg.norm(ours - reference) < np.linalg.norm(grid - reference)


def test_blur_and_its_adjoint():
    """<blur(x), y> = <x, adjoint(y)> for images that reach the border, and the blur is scipy's."""
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 9, 12))
    taps = blur_taps(1.3)
    scratch, blurred, adjoint = np.zeros((3, 9, 12))
    whole = np.array([0, 12, 0, 9])
    blur_rectangle(x, taps, whole, scratch, blurred)
    blur_adjoint(y, taps, whole, scratch, adjoint)
    assert np.allclose(blurred, blur(x, 1.3), atol=1e-14)
    assert np.isclose(np.sum(blurred * y), np.sum(x * adjoint), rtol=1e-12)


def test_forward_and_reverse_agree():
    """One reverse pass gives what the Jacobian images give: the same sums in another order."""
    solids = scene(3, BOX, stacked=True)
    rng = np.random.default_rng(0)
    observed = antialiased_depth(solids, CAMERA, BACKGROUND, BLUR) + rng.normal(0, 0.02, (64, 64))
    observed[10:20, 5:30] = np.nan
    likelihood = SmoothLikelihood(CAMERA, observed, solids.kind, 0.01, BLUR, BACKGROUND, parameters=MOTION)
    value, reverse = likelihood.gradient(solids)
    motions = np.zeros((MOTION, 5, MOTION))
    motions[np.arange(MOTION), 2, np.arange(MOTION)] = 1.0
    _, gradient, hessian = likelihood.equations(solids.pose, solids.size, motions)
    assert np.allclose(-gradient, reverse[2], rtol=1e-9, atol=1e-9 * np.abs(reverse).max())
    assert np.linalg.eigvalsh(hessian)[0] > -1e-9 * np.abs(hessian).max()
    residual = (antialiased_depth(solids, CAMERA, BACKGROUND, BLUR) - observed)[np.isfinite(observed)]
    expected = -np.sum(0.5 * (residual / 0.01) ** 2 + np.log(0.01 * np.sqrt(2 * np.pi)))
    assert np.isclose(value, expected, rtol=1e-12)
