"""The made scenes of scripts/frontier.py say what is in their images."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from derender.detection.solids.image import make_row
from derender.detection.solids.interpenetration import penetration
from derender.scene.solids import BOX
from worlds.frontier_scenes import BEHIND, KINDS, make, phone, stereo


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind not in ("clutter", "heap")])
def test_labels_are_of_the_objects_and_a_seed_gives_the_same_scene(kind):
    scene, again = (make(np.random.default_rng(5), kind) for _ in range(2))
    assert np.array_equal(scene.depth, again.depth, equal_nan=True)
    assert scene.depth.shape == scene.label.shape == scene.camera.shape
    assert scene.label.min() >= BEHIND and scene.label.max() < len(scene.objects)
    for item in scene.objects:
        assert item["parent"] in scene.tables or scene.objects[item["parent"]]["pose"] is not item["pose"]


@pytest.mark.parametrize("kind", ["boards", "pallets"])
def test_what_leans_or_is_stacked_touches_and_does_not_interpenetrate(kind):
    scene = make(np.random.default_rng(3), kind)
    up = np.linalg.inv(scene.tables["floor"])
    rows = [make_row(BOX, (up @ o["pose"])[:3, :3], (up @ o["pose"])[:3, 3], o["size"]) for o in scene.objects]
    apart = [penetration(a, b) for k, a in enumerate(rows) for b in rows[:k]]
    assert max(apart) < 1e-6 and (kind == "pallets" or max(apart) > -1e-6)


def test_stereo_fattens_what_is_near_and_a_phone_is_off_by_one_percent():
    depth = np.full((96, 128), 1.2)
    depth[30:60, 40:90] = 0.8
    fat = stereo(np.random.default_rng(0), depth) < 1.0
    assert 1.02 * 30 * 50 < fat.sum() < 1.25 * 30 * 50
    steps = 30.0 / stereo(np.random.default_rng(0), depth) * 32.0
    assert np.nanmax(np.abs(steps - np.round(steps))) < 1e-6
    flat = phone(np.random.default_rng(0), np.full((96, 128), 1.0))
    assert abs(abs(np.mean(flat) - 1.0) - 0.01) < 0.002


def test_the_script_says_what_the_kinds_are():
    script = Path(__file__).parents[2] / "scripts" / "frontier.py"
    told = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True, check=True).stdout
    assert all(kind in told for kind in KINDS)
