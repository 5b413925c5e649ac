"""Pairs of files and folders, and totals."""

import pytest

from derender.errors import DerenderError
from derender.evaluation.metrics import paired, totals


def touch(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x")
    return folder


def test_pairs(tmp_path):
    left = touch(tmp_path / "left", "a/scene.yaml", "a/posterior.npz", "b.yaml", "c.json", "b.npz", "notes.txt")
    right = touch(tmp_path / "right", "a.yaml", "b.json", "b.png", "c.png")
    found = paired(left, right)
    assert [name for name, _, _ in found] == ["a", "b", "c"]
    assert [path.name for _, path, _ in found] == ["a", "b.yaml", "c.json"]
    assert [path.name for _, _, path in found] == ["a.yaml", "b.json", "c.png"]
    # Two single things are a pair whatever they are called; a folder with a scene in it is single.
    assert paired(left / "a", right / "b.json")[0][0] == "a"
    assert paired(left / "b.yaml", right / "c.png")[0][0] == "b"


def test_what_a_run_over_many_frames_leaves_beside_its_scenes_is_none(tmp_path):
    run = touch(tmp_path / "run", "a/scene.yaml", "batch.json", "results.jsonl", "results.csv", "index.html")
    assert [name for name, _, _ in paired(run, run)] == ["a"]


def test_pairs_that_cannot_be(tmp_path):
    left = touch(tmp_path / "left", "a.yaml")
    right = touch(tmp_path / "right", "a.yaml", "b.yaml")
    empty = tmp_path / "empty"
    empty.mkdir()
    for a, b, words in (
        (left, right, "1 of 2 scenes have no prediction: b"),
        (left / "a.yaml", right, "two files or two folders"),
        (left, empty, "no scene"),
        (left / "a.yaml", empty, "no scene"),
        (left, tmp_path / "nowhere", "no such"),
    ):
        with pytest.raises(DerenderError, match=words):
            paired(a, b)


def rates(hits, predicted, truth):
    return {"hits": hits, "predicted": predicted, "truth": truth}


def result(hits, exact, stable, position):
    return {
        "objects": {key: rates(hits, 2, 2) for key in ("0.5", "0.75", "0.9")},
        "edges": None if exact is None else rates(hits, 2, 2),
        "graph_exact": exact,
        "pairs": [{"position": position, "rotation": None, "add_s": position, "size": [0.0, -position, 0.0]}],
        "condition": {"floating": [], "intersecting": [], "stable": stable, "fallen": []},
    }


def test_totals_pool_hits_and_count_scenes():
    found = totals([result(2, True, True, 0.001), result(1, False, False, 0.003), result(0, None, None, 0.002)])
    # F1 over all objects, not the mean of the scenes' F1: 3 of 6 said, of 6 true.
    assert found["f1@0.5"] == pytest.approx(0.5) and found["edge_f1"] == pytest.approx(3 / 4)
    assert found["graph_exact"] == 0.5 and found["stable"] == 0.5 and found["floating"] == 0
    assert found["median_position"] == pytest.approx(0.002) and found["median_size"] == pytest.approx(0.002)
    assert found["median_rotation"] is None and found["mask_f1"] is None
    masks = totals([{"masks": rates(1, 1, 2)}, {"masks": rates(3, 4, 3)}])
    assert masks["mask_f1"] == pytest.approx(2 * 4 / 10) and masks["scenes"] == 2
