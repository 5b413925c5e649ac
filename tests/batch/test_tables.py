"""Names of frames, tables and the page of many frames, without inferring any."""

import csv
import io
import json
import math
import os
import time
from concurrent.futures import ThreadPoolExecutor, wait

import numpy as np
import pytest

from derender.atomic import locked
from derender.batch.frames import Done, Frame, Order, Watch, failure, find_frames, is_many, rows_in
from derender.batch.ledger import Ledger, index_page
from derender.batch.run import duration, words
from derender.camera.depth_file import read_depth, write_depth
from derender.camera.image_files import png_bytes
from derender.errors import DerenderError
from derender.results.table import COLUMNS, as_csv, as_lines, extents_text, failed_row, read_lines, rows_of, turn_of
from derender.scene.pose import rotation_x, rotation_z, translation
from derender.structures.options import Options


def summary(*objects, trusted=True, doubts=()):
    scene = {"frame": "camera", "gravity": [0.0, 9.81, 0.0], "objects": list(objects)}
    return {"scene": scene, "trusted": trusted, "doubts": list(doubts)}


def box(name="box_1", size=(0.2, 0.1, 0.05), pose=None, interval=True):
    pose = translation(0.1, 0.2, 0.9) if pose is None else pose
    ranges = [[0.9 * side, 1.1 * side] for side in size]
    return {"name": name, "type": "box", "size": list(size), "pose": pose.tolist(), "parent": "floor",
            "probability": 0.97, **({"size_interval": ranges} if interval else {})}  # fmt: skip


FLOOR = {"name": "floor", "type": "plane", "size": None, "pose": np.eye(4).tolist(), "parent": "root"}


def test_frames_are_found_in_folders_patterns_and_by_name(tmp_path):
    folder = tmp_path / "frames"
    (folder / "more").mkdir(parents=True)
    (folder / "made").mkdir()
    for name in ("b.npy", "a.npz", "more/a.png", ".hidden.npy", "notes.txt", "made/posterior.npz", "made/summary.json"):
        (folder / name).write_bytes(b"x")
    (folder / "colour.png").write_bytes(png_bytes(np.zeros((2, 2, 3), np.uint8)))
    (folder / "out").mkdir()
    (folder / "out" / "frame.npy").write_bytes(b"x")
    told: list[str] = []
    found = find_frames([str(folder)], folder / "out", warn=told.append)
    assert [frame.name for frame in found] == ["a", "b", "more/a"]
    assert len(told) == 1 and "1 PNG of 8 bits a pixel (colours or masks) left out" in told[0]
    assert find_frames([str(folder / "*.np?")], folder / "out") == [found[0], found[1]]
    named = find_frames([str(folder / "colour.png"), "missing.npy", str(folder / "colour.png")], tmp_path / "out")
    assert [frame.name for frame in named] == ["colour", "missing"]
    again = [str(folder / "a.npz"), str(folder / "made" / ".." / "a.npz")]  # one file
    assert [frame.name for frame in find_frames(again, tmp_path / "out")] == ["a"]
    with pytest.raises(DerenderError, match="no depth image is there;"):
        find_frames([str(folder / "*.exr")], tmp_path)
    for output in (folder, tmp_path):  # what lies in the results' folder is no frame
        with pytest.raises(DerenderError, match="the results would lie where the frames do; choose another -o"):
            find_frames([str(folder)], output)
    with pytest.raises(DerenderError, match="no depth image is there but 1 PNG of 8 bits"):
        find_frames([str(folder / "*.png")], tmp_path / "out")


def test_links_that_lead_up_and_what_is_no_file_give_no_frame(tmp_path):
    (tmp_path / "a.npy").write_bytes(b"x")
    (tmp_path / "folder.npy").mkdir()
    (tmp_path / "self").symlink_to(".")
    os.mkfifo(tmp_path / "pipe.npy")
    for argument in (tmp_path, tmp_path / "**" / "*.npy"):
        assert [frame.name for frame in find_frames([str(argument)], tmp_path / "out")] == ["a"]


def test_a_name_that_no_table_could_hold_is_left_out(tmp_path):
    (tmp_path / "a.npy").write_bytes(b"x")
    (tmp_path / os.fsdecode(b"b\xff.npy")).write_bytes(b"x")
    told = []
    assert [frame.name for frame in find_frames([str(tmp_path)], tmp_path / "out", warn=told.append)] == ["a"]
    assert len(told) == 1 and "is not UTF-8" in told[0]


def test_no_two_frames_share_a_name(tmp_path):
    found = find_frames(["../one/a.npy", "two/a.npy", "two/a.png", "b.npy"], tmp_path)
    assert [frame.name for frame in found] == ["one/a", "two/a.npy", "two/a.png", "b"]


def test_what_is_more_than_one_image(tmp_path):
    assert is_many(["a.npy", "b.npy"]) and is_many([str(tmp_path)]) and is_many(["*.npy"])
    assert not is_many(["a.npy"])
    (tmp_path / "a[1].npy").write_bytes(b"x")  # a file of that name, no pattern
    assert not is_many([str(tmp_path / "a[1].npy")])


def test_a_file_that_grows_is_left_alone(tmp_path, monkeypatch):
    clock = [100.0]
    monkeypatch.setattr("derender.batch.frames.time.monotonic", lambda: clock[0])
    watch = Watch([str(tmp_path)], tmp_path / "out")
    assert watch.look() == []
    (tmp_path / "a.npy").write_bytes(b"1")
    looks = [watch.look()]
    for data, later in ((b"12", 0.8), (b"123", 0.8), (b"123", 0.6), (b"123", 0.6), (b"123", 2.0)):
        (tmp_path / "a.npy").write_bytes(data) if (tmp_path / "a.npy").read_bytes() != data else None
        clock[0] += later
        looks.append(watch.look())
    assert [len(look) for look in looks] == [0, 0, 0, 0, 1, 0]
    (tmp_path / "a.npy").write_bytes(b"1234")  # its copy had stalled
    looks, later = [watch.look()], clock[0] + 1.5
    clock[0] = later
    looks += [watch.look(busy={"a"}), watch.look(), watch.look()]
    assert [len(look) for look in looks] == [0, 0, 1, 0]


def test_frames_of_folders_above_and_below_have_names_of_their_own(tmp_path, monkeypatch):
    """Of `run/a.npy ../run/a.npy` one took the place of the other."""
    here = tmp_path / "here"
    for folder in (tmp_path / "run", here / "run"):
        folder.mkdir(parents=True)
        (folder / "a.npy").write_bytes(b"x")
    monkeypatch.chdir(here)
    names = [frame.name for frame in find_frames(["run/a.npy", "../run/a.npy"], "out")]
    assert len(set(names)) == 2 and all(name.endswith("run/a.npy") for name in names)


def test_a_file_that_was_written_seconds_ago_may_still_grow(tmp_path):
    """A slow copy stalls for seconds; one that lay there for minutes is taken at once."""
    for name, ago in (("stalls.npy", 10.0), ("lay.npy", 600.0)):
        (tmp_path / name).write_bytes(b"1")
        os.utime(tmp_path / name, (time.time() - ago,) * 2)
    assert [frame.name for frame in Watch([str(tmp_path)], tmp_path / "out").look()] == ["lay"]


def test_rows_hold_size_place_and_turn():
    pose = translation(0.1, 0.2, 0.9) @ rotation_x(math.pi / 2) @ rotation_z(0.3)  # its z upwards, against gravity
    rows = rows_of("a/b", summary(FLOOR, box(pose=pose), box("box_2", interval=False), doubts=["why"], trusted=False))
    assert [row["object"] for row in rows] == ["box_1", "box_2"] and all(set(row) == set(COLUMNS) for row in rows)
    first = rows[0]
    assert (first["length"], first["length_low"], first["height_high"]) == (0.2, 0.18, 0.055)
    assert (first["x"], first["y"], first["z"], first["rests_on"]) == (0.1, 0.2, 0.9, "floor")
    assert first["turn"] == pytest.approx(0.3, abs=1e-5) and rows[1]["length_low"] is None
    assert first["trusted"] is False and first["doubts"] == ["why"]


def test_a_range_that_is_not_about_its_value_is_told_by_both_ends():
    """Of a side that is hidden the likeliest extent is the least: 9.3 ± 3.9 cm stood where it was 9.1 to 16.8."""
    assert extents_text([0.093, 0.1], [(0.091, 0.168), (0.0985, 0.1005)]) == "9.3 (9.1 to 16.8) × 10.0 ± 0.1"
    assert extents_text([0.05], [(0.05, 0.05)]) == extents_text([0.05]) == "5.0"
    assert extents_text([0.093], [(0.0931, 0.0935)]) == "9.30 (9.31 to 9.35)"


def test_turn_is_seen_from_above_whatever_the_camera_sees():
    for tilt in (0.2, 0.9, 1.5):
        down = rotation_x(tilt) @ np.array([0.0, 1.0, 0.0, 0.0])
        up_frame = rotation_x(tilt) @ rotation_x(math.pi / 2)
        assert turn_of(up_frame @ rotation_z(-0.7), down[:3]) == pytest.approx(-0.7)
    assert turn_of(rotation_z(math.pi / 2), [0.0, 9.81, 0.0]) == 0.0  # its x is upright


def test_the_best_scene_alone_has_no_ranges_but_the_probability_that_the_terminal_says():
    (row,) = rows_of("a", summary(FLOOR, box(interval=False)))
    assert row["length"] == 0.2 and row["length_low"] is None and row["probability"] == 0.97


def test_lines_and_csv_hold_the_same(tmp_path):
    rows = [
        *rows_of("a", summary(box(), doubts=["one", "two, of two"])),
        *rows_of("b", summary()),
        failed_row("c", "x"),
    ]
    path = tmp_path / "results.jsonl"
    path.write_text(as_lines(rows) + '{"frame": "d", "obj')  # a killed writer's half line
    assert list(read_lines(path)) == rows
    table = list(csv.DictReader(io.StringIO(as_csv(rows))))
    assert [row["frame"] for row in table] == ["a", "b", "c"] and table[1]["object"] == ""
    assert table[0]["doubts"] == "one; two, of two" and [row["trusted"] for row in table] == ["true", "true", "false"]
    assert float(table[0]["length_high"]) == rows[0]["length_high"] and table[2]["status"] == "failed"


def done_folder(folder, name, told):
    (folder / name).mkdir(parents=True)
    (folder / name / "summary.json").write_text(json.dumps(told))
    (folder / name / "thumbnail.png").write_bytes(b"x")


def test_a_ledger_goes_on_where_it_was_killed(tmp_path):
    """Frames whose folder is whole are done, with or without lines; those with lines and no folder are not."""
    order = Order(Options(seed=1), words=["--seed", "1"])
    frames = [Frame(name, name + ".npy") for name in "abcd"]
    for name in "ab":
        done_folder(tmp_path, name, summary(box()))
    (tmp_path / "c").mkdir()
    (tmp_path / "results.jsonl").write_text(as_lines(rows_of("a", summary(box()))) + '{"frame": "b"')
    ledger = Ledger(tmp_path, order)
    assert [frame.name for frame in ledger.missing(frames)] == ["c", "d"]
    ledger.record(Done(frames[3], [failed_row("d", "too dark")]))
    ledger.record(Done(frames[2], rows_of("c", summary())))
    ledger.write_tables(ended=True)
    rows = list(read_lines(tmp_path / "results.jsonl"))
    assert [(row["frame"], row["status"]) for row in rows] == [
        ("a", "done"), ("b", "done"), ("c", "done"), ("d", "failed")]  # fmt: skip
    assert (tmp_path / "results.csv").read_text() == as_csv(rows)
    done_folder(tmp_path, "d", summary(box(), box("box_2")))  # as a later run leaves it
    again = Ledger(tmp_path, order)
    assert [frame.name for frame in again.missing(frames)] == ["c"]  # its folder is not whole
    again.write_tables(ended=True)
    last = [row for row in read_lines(tmp_path / "results.jsonl") if row["frame"] == "d"]
    assert [row["object"] for row in last] == ["box_1", "box_2"]


@pytest.mark.parametrize("told", [{}, {"scene": {"objects": [{}]}, "trusted": 1, "doubts": 5}])
def test_what_is_broken_in_the_folder_is_made_again(tmp_path, told):
    line = {"frame": "a", "status": "done", "trusted": True, "doubts": []}
    junk = [json.dumps(line | wrong) for wrong in ({"doubts": 5}, {"doubts": [1]}, {"object": {}}, {"length": "x"})]
    lines = ["[]", '{"frame": "a", "status": 5}', "[" * 100_000, *junk]
    (tmp_path / "results.jsonl").write_bytes(b"\xff\xfe\n" + "\n".join(lines).encode() + b"\n")
    done_folder(tmp_path, "a", told)
    ledger = Ledger(tmp_path, Order())
    assert not ledger.rows and ledger.missing([Frame("a", "a.npy")]) == [Frame("a", "a.npy")]


def test_a_result_that_another_process_replaces_is_read_whole(tmp_path):
    done_folder(tmp_path, "a", summary(box()))
    with ThreadPoolExecutor(1) as pool:
        with locked(tmp_path / "a"):
            (tmp_path / "a" / "summary.json").unlink()
            found = pool.submit(rows_in, tmp_path / "a", "a")
            wait([found], timeout=0.2)  # as long as a reader that does not wait has to fail
            (tmp_path / "a" / "summary.json").write_text(json.dumps(summary(box("new"))))
        assert [row["object"] for row in found.result()] == ["new"]


def test_what_was_removed_by_hand_is_in_no_table_any_more(tmp_path):
    """A result goes with its folder, a failure with its image; another run's failure stays where its image is."""
    order, out = Order(), tmp_path / "out"
    names = ("bad", "dark", "film.bag@3", "gone.bag@7")
    for name in ("dark", "film.bag"):
        (tmp_path / name).touch()
    ledger = Ledger(out, order)
    for name in ("kept", "gone"):
        done_folder(out, name, summary(box()))
        ledger.record(Done(Frame(name, name + ".npy"), rows_of(name, summary(box()))))
    for name in names:
        ledger.record(failure(Frame(name, str(tmp_path / name)), "too dark"))
    ledger.write_tables(ended=True)
    assert '"bad"' in (out / "results.jsonl").read_text()  # a run tells its own failures, also of what was never there
    (out / "gone" / "summary.json").unlink()
    Ledger(out, order).write_tables(ended=True)
    for file in ("results.jsonl", "results.csv", "index.html"):
        text = (out / file).read_text()
        assert all(name in text for name in ("kept", "dark", "film.bag@3")), file
        assert not any(name in text for name in ("gone", "bad<", "bad,", '"bad"')), file


def test_results_of_other_options_are_not_mixed(tmp_path):
    Ledger(tmp_path, Order(words=["--draws", "5"]))
    Ledger(tmp_path, Order(words=["--quick"]))  # the run before it made no result
    done_folder(tmp_path, "more/a", summary(box()))
    with pytest.raises(DerenderError, match=r"other options \(--quick\); give the same ones, or another folder"):
        Ledger(tmp_path, Order(words=["--method", "mcmc"]))


def test_results_of_another_prior_are_not_mixed(tmp_path):
    prior = tmp_path / "prior.yaml"
    prior.write_text("first")
    order, out = Order(prior=str(prior), words=["--scene", str(prior)]), tmp_path / "out"
    Ledger(out, order)
    Ledger(out, order)
    done_folder(out, "a", summary(box()))
    prior.write_text("second")
    with pytest.raises(DerenderError, match=r"prior\.yaml has changed since the results here were made"):
        Ledger(out, order)
    (out / "batch.json").write_text(json.dumps({"options": list(order.words), "seed": 0}))  # of an older version
    Ledger(out, order)


@pytest.mark.parametrize("gone", ["image", "thumbnail"])
def test_lines_of_a_result_that_is_made_again_are_told_no_more(tmp_path, gone):
    """What was found in an image that has been replaced stood in the tables beside what is found in the new one."""
    image = tmp_path / "a.npy"
    np.save(image, np.full((48, 64), 0.9, np.float32))
    frame, out, warnings = Frame("a", str(image)), tmp_path / "out", []
    ledger = Ledger(out, Order())
    done_folder(out, "a", summary(box("old")))
    write_depth(out / "a" / "observation.npz", read_depth(image).depth, read_depth(image).camera)
    ledger.record(Done(frame, rows_of("a", summary(box("old")))))
    os.utime(image)  # touched, as by a copy, and the same
    assert Ledger(out, Order()).missing([frame], warnings.append) == [] == warnings
    if gone == "image":
        np.save(image, np.full((48, 64), 1.1, np.float32))
    else:
        (out / "a" / "thumbnail.png").unlink()
    again = Ledger(out, Order())
    assert again.missing([frame], warnings.append) == [frame] and len(warnings) == (gone == "image")
    again.record(Done(frame, rows_of("a", summary(box("new")))))
    again.write_tables(ended=True)
    assert [row["object"] for row in read_lines(out / "results.jsonl")] == ["new"]


def test_two_processes_may_find_the_same_result_outdated(tmp_path, monkeypatch):
    image, out = tmp_path / "a.npy", tmp_path / "out"
    np.save(image, np.full((48, 64), 0.9, np.float32))
    frame, seen = Frame("a", str(image)), read_depth(image)
    done_folder(out, "a", summary(box("old")))
    write_depth(out / "a" / "observation.npz", seen.depth, seen.camera)
    (out / "a" / "thumbnail.png").unlink()
    monkeypatch.setattr("derender.batch.ledger.is_done", lambda folder: True)  # as it was a moment ago
    assert Ledger(out, Order()).missing([frame]) == [frame]


@pytest.mark.parametrize("told", ["5", '{"options": [1]}', '{"options": 5}', "[" * 100_000, "\x00"])
def test_what_does_not_say_which_options_there_were_is_of_others(tmp_path, told):
    (tmp_path / "batch.json").write_text(told)
    done_folder(tmp_path, "a", summary(box()))
    with pytest.raises(DerenderError, match=r"other options \(none\)"):
        Ledger(tmp_path, Order())


def test_the_page_names_every_frame_and_escapes_it(tmp_path):
    rows = {
        "<a>/1": rows_of("<a>/1", summary(FLOOR, box("<b>"))),
        "dark": [failed_row("dark", "no pixel & more")],
        "odd": rows_of("odd", summary(trusted=False, doubts=["the fit is poor"])),
    }
    page = index_page(tmp_path, rows)
    assert "&lt;a&gt;/1" in page and "<b>:" not in page and "&lt;b&gt;: 20.0 ± 2.0 × 10.0 ± 1.0 × 5.0 ± 0.5" in page
    assert page.index("in centimetres") < page.index("<table")  # of thousands of frames nobody sees the end
    assert 'src="%3Ca%3E/1/thumbnail.png"' in page and "no pixel &amp; more" in page
    assert [page.count(f'data-state="{state}"') for state in ("trusted", "doubtful", "failed")] == [1, 1, 1]
    marked = index_page(tmp_path, {"a\x1b[31m\u202e": [failed_row("a", "no pixel")]})
    assert "a\\x1b[31m\\u202e" in marked and not {"\x1b", "\u202e"} & set(marked)
    assert "is made, in this folder, by <code>derender view &#x27;&lt;a&gt;/1&#x27;</code>" in page
    for name in ("<a>/1", "odd"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "report.html").touch()
    assert "is made" not in index_page(tmp_path, rows)  # each has its page
    sure = {"sure": rows_of("sure", summary(FLOOR, box() | {"probability": 0.9999}))}
    assert "p &gt;.99" in index_page(tmp_path, sure)  # as everywhere: no more than that is said
    open_type = {"open": rows_of("open", summary(FLOOR, box() | {"type_probability": {"box": 0.35, "cube": 0.65}}))}
    assert open_type["open"][0]["type_probability"] == 0.35 and rows["<a>/1"][0]["type_probability"] is None
    assert "box_1, box (p .35): 20.0 ± 2.0" in index_page(tmp_path, open_type)
    quick = {"quick": rows_of("quick", summary(FLOOR, box(interval=False)))}
    assert "90 % ranges" in page and "90 % ranges" not in index_page(tmp_path, quick)  # none are shown, none are told


def test_the_bar_says_what_is_left():
    assert words(0, 12, 1.0) == "12 of 12 frames left"
    assert words(3, 12, 30.0) == "9 of 12 frames left, 90 s"
    assert words(12, 12, 30.0, watch=True) == "12 frames done, watching"
    assert [duration(seconds) for seconds in (3.4, 200, 7500)] == ["3 s", "3 min", "2 h 05 min"]


def test_a_frame_that_is_named_like_an_option_is_viewed_all_the_same(tmp_path):
    rows = rows_of("-x", summary(FLOOR, box()))
    page = index_page(tmp_path, {"-x": rows})
    assert "<code>derender view ./-x</code>" in page
