"""Truth files as other tools write them, and scenes judged by physics."""

import json

import numpy as np
import pytest
import trimesh

from derender.errors import DerenderError
from derender.evaluation.metrics import add_s, compare_scenes, condition_of, paired, pose_and_size_errors
from derender.evaluation.truth import checked_scene, read_json_scene, read_labels


def box(name, x, z, parent="floor", size=0.1):
    pose = np.eye(4)
    pose[:3, 3] = x, 0, z
    return {"name": name, "type": "box", "size": [size] * 3, "pose": pose.tolist(), "parent": parent}


FLOOR = {"name": "floor", "type": "plane", "size": None, "pose": np.eye(4).tolist(), "parent": "root"}
SCENE = {"frame": "camera", "gravity": [0, 0, -9.81], "objects": [FLOOR, box("a", 0, 0.05), box("b", 0.02, 0.15, "a")]}


def write_bop(folder):
    """Write a frame as BOP's tools do: millimetres, one row of nine numbers, models' origins off their middles."""
    turned = [0, -1, 0, 1, 0, 0, 0, 0, 1]
    frame = [{"cam_R_m2c": turned, "cam_t_m2c": [100.0, 0.0, 800.0], "obj_id": 5}]
    twice = frame + [{"cam_R_m2c": turned, "cam_t_m2c": [300.0, 0.0, 800.0], "obj_id": 5}]
    (folder / "test" / "000001").mkdir(parents=True)
    path = folder / "test" / "000001" / "scene_gt.json"
    path.write_text(json.dumps({"3": frame, "17": twice}))
    info = {"5": {"diameter": 130, "min_x": 0, "min_y": -20, "min_z": 0, "size_x": 100, "size_y": 40, "size_z": 60}}
    (folder / "models").mkdir()
    (folder / "models" / "models_info.json").write_text(json.dumps(info))
    return path


def test_bop_frame(tmp_path):
    path = write_bop(tmp_path)
    scene = read_json_scene(path, frame="3")
    (item,) = scene["objects"]
    assert item["name"] == "object_5" and item["size"] == pytest.approx([0.1, 0.04, 0.06])
    # The middle of the box in the model is (50, 0, 30) mm; a quarter turn about z makes that (0, 50, 30).
    np.testing.assert_allclose(np.array(item["pose"])[:3, 3], [0.1, 0.05, 0.83])
    assert [item["name"] for item in read_json_scene(path, frame="17")["objects"]] == ["object_5", "object_5_2"]
    compared = compare_scenes(scene, scene)
    assert compared["edges"] is None and compared["graph_exact"] is None and compared["objects"]["0.9"]["f1"] == 1
    with pytest.raises(DerenderError, match="--frame"):
        read_json_scene(path)
    with pytest.raises(DerenderError, match="no frame '4'"):
        read_json_scene(path, frame="4")
    with pytest.raises(DerenderError, match="--models"):
        read_json_scene(path, frame="3", models=tmp_path / "nowhere.json")


@pytest.mark.parametrize("change", [{"min_x": None}, {"size_z": "x"}, {"symmetries_discrete": 5}])
def test_models_that_are_none_are_told(tmp_path, change):
    path = write_bop(tmp_path)
    place = tmp_path / "models" / "models_info.json"
    place.write_text(json.dumps({"5": json.loads(place.read_text())["5"] | change}))
    with pytest.raises(DerenderError, match=f"models_info.5.{next(iter(change))} is not as BOP has it"):
        read_json_scene(path, frame="3")


def test_bop_models_and_symmetries(tmp_path):
    """Beside models_info.json lies the model, a wedge; and the former says what turns leave it as it is."""
    path = write_bop(tmp_path)
    wedge = trimesh.convex.convex_hull(np.array([[0, y, z] for y in (-20, 20) for z in (0, 60)] + [[100, 20, 0]]))
    wedge.export(tmp_path / "models" / "obj_000005.ply")
    information = tmp_path / "models" / "models_info.json"
    info = json.loads(information.read_text())
    info["5"]["symmetries_discrete"] = [np.diag([-1.0, -1.0, 1.0, 1.0]).ravel().tolist()]
    information.write_text(json.dumps(info))
    scene = read_json_scene(path, frame="3")
    (item,) = scene["objects"]
    np.testing.assert_allclose(item["vertices"].min(axis=0), [-0.05, -0.02, -0.03], atol=1e-9)
    half = {**item, "pose": (np.array(item["pose"]) @ np.diag([-1.0, -1.0, 1.0, 1.0])).tolist()}
    assert pose_and_size_errors(half, item)["rotation"] == pytest.approx(0.0, abs=1e-9)
    assert pose_and_size_errors(half, {**item, "symmetries": [np.eye(3)]})["rotation"] == pytest.approx(np.pi)
    # ADD-S: of the wedge against itself none, of its box some
    box = {key: value for key, value in item.items() if key != "vertices"}
    assert add_s(item, item) < 5e-4 < 2e-3 < add_s(box, item)
    info["5"] |= {"symmetries_discrete": [], "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]}
    information.write_text(json.dumps(info))
    (round_item,) = read_json_scene(path, frame="3")["objects"]
    assert pose_and_size_errors(half, round_item)["rotation"] < 0.05
    (tmp_path / "models" / "obj_000005.ply").write_text("nothing")
    with pytest.raises(DerenderError, match="this is no mesh"):
        read_json_scene(path, frame="3")


def test_scene_of_show_json(tmp_path):
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(SCENE))
    assert read_json_scene(path)["objects"] == SCENE["objects"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"name": None}, "objects.1.name"),
        ({"name": "b"}, "two objects"),
        ({"type": 3}, "objects.1.type"),
        ({"pose": [[1, 2], [3, 4]]}, "objects.1.pose"),
        ({"parent": ["floor"]}, "objects.1.parent"),
        ({"pose": (2 * np.eye(4)).tolist()}, "rigid"),
        ({"size": [0.1, -0.1, 0.1]}, "positive"),
        ({"size": None}, "positive"),
        ({"size": [0.1, float("nan"), 0.1]}, "objects.1.size"),
    ],
)
def test_a_scene_that_cannot_be_compared_is_refused(change, words):
    with pytest.raises(DerenderError, match=words):
        checked_scene(SCENE | {"objects": [FLOOR, SCENE["objects"][1] | change, SCENE["objects"][2]]})


@pytest.mark.parametrize("text", ["", "not json", "[1, 2]", "{}", '{"1": [{"obj_id": 3}]}'])
def test_other_json_is_refused(tmp_path, text):
    path = tmp_path / "x.json"
    path.write_text(text)
    with pytest.raises(DerenderError):
        read_json_scene(path)


def test_label_images(tmp_path):
    from PIL import Image

    labels = np.array([[0, 10, 21], [22, 30, 30]], dtype=np.uint8)
    Image.fromarray(labels).save(tmp_path / "label.png")
    np.save(tmp_path / "label.npy", labels)
    coloured = Image.fromarray(labels)
    coloured.putpalette(list(range(256)) * 3)
    coloured.save(tmp_path / "palette.png")  # numbers of colours are labels too
    for name in ("label.png", "label.npy", "palette.png"):
        np.testing.assert_array_equal(read_labels(tmp_path / name, divisor=10), [[0, 1, 2], [2, 3, 3]])
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "colour.png")
    (tmp_path / "empty.png").write_bytes(b"")
    np.save(tmp_path / "words.npy", np.array([["a", "b"]]))
    np.save(tmp_path / "nan.npy", np.array([[np.nan, 1.0]]))
    for name in ("colour.png", "empty.png", "missing.png", "words.npy", "nan.npy"):
        with pytest.raises(DerenderError):
            read_labels(tmp_path / name)


def test_condition_of_scenes():
    assert condition_of(SCENE) == {"floating": [], "intersecting": [], "stable": True, "fallen": []}
    leaning = SCENE | {"objects": [FLOOR, box("a", 0, 0.05), box("b", 0.07, 0.15, "a")]}
    assert condition_of(leaning)["fallen"] == ["b"] and condition_of(leaning)["stable"] is False
    up = SCENE | {"objects": [FLOOR, box("a", 0, 0.25), box("b", 0.02, 0.33, "a")]}
    found = condition_of(up)
    assert found["floating"] == ["a", "b"] and found["intersecting"][0][:2] == ["a", "b"] and not found["stable"]
    alone = SCENE | {"objects": [FLOOR, box("a", 0, 0.25)]}
    assert condition_of(alone)["floating"] == ["a"]
    assert condition_of(alone | {"gravity": [0, 0, 0]})["stable"] is None


def test_a_film_is_no_scene(tmp_path):
    """It was called a folder of scenes, and its file was told to hold no pose as `show --json` has it."""
    (tmp_path / "track.json").write_text(json.dumps({"objects": [{"name": "box_1", "poses": [None]}]}))
    with pytest.raises(DerenderError, match="this folder holds a film, and eval compares scenes"):
        paired(tmp_path, tmp_path / "track.json")
    with pytest.raises(DerenderError, match="this is a film, a pose for each frame"):
        read_json_scene(tmp_path / "track.json")
