"""What is written can be read again and keeps to the contract of track.json."""

import json

import films
import numpy as np
import pytest
from browser import needed, violations

from derender.tracking.events import events_of
from derender.tracking.result import FILES, report_page, track_json, with_materials, write_track
from derender.tracking.track import Recorder


def made():
    paths = [[films.at(0.01 * t, 0, 0.035)] for t in range(4)]
    frames, poses = films.film(np.random.default_rng(0), ["box"], [[0.08, 0.06, 0.07]], paths)
    start = films.start(["box"], [[0.08, 0.06, 0.07]], poses[0])
    recorder = Recorder(frames[0], films.CAMERA, start, [0, 9, 4], 1 / films.FPS)
    for frame in frames[1:]:
        recorder.advance(frame)
    return recorder.track(frames=[f"{t}" for t in range(4)]), frames


def test_a_track_is_written_as_it_is(tmp_path):
    track, frames = made()
    page = report_page(track, frames, films.CAMERA, events_of(track), "a film")
    write_track(tmp_path, track, page, {"seed": 3, "command": "test"})
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(FILES)
    with np.load(tmp_path / "track.npz", allow_pickle=False) as again:
        assert again["names"].tolist() == track.names and again["states"].tolist() == track.states
        assert np.array_equal(again["poses"], track.poses)
        assert np.array_equal(again["parent_probability"], track.parent_probability)
    told = json.loads((tmp_path / "track.json").read_text())
    assert told["seed"] == 3 and told["version"] and len(told["objects"][0]["poses"]) == 4
    lines = [json.loads(line) for line in (tmp_path / "events.jsonl").read_text().splitlines()]
    assert {"frame", "time", "event", "object"} <= set(lines[0])
    assert "<pre>friction 0.3 &lt; 1</pre>" in with_materials(page, ["friction 0.3 < 1"])
    assert "<h2>Events</h2><p>None.</p>" in report_page(track, frames, films.CAMERA, [], "a film")
    assert page.count('class="shot"') == 4 and "http" not in page.replace("http://www.w3.org", "")


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_axe_finds_no_violation_in_a_film_s_page(tmp_path, dark):
    needed(axe=True)
    track, frames = made()
    assert violations(report_page(track, frames, films.CAMERA, events_of(track), "a film"), tmp_path, dark) == []


def test_what_is_lost_is_null_in_the_json_and_counted():
    track, _ = made()
    track.poses[2, 0] = np.nan
    track.parent_probability[2, 0] = np.nan
    track.states[2][0] = "lost"
    item = track_json(track)["objects"][0]
    assert item["poses"][2] is None and item["parents"][2] is None and item["lost"] == [2]
    assert item["type"] == "box" and len(item["size"]) == 3
    json.dumps(track_json(track), allow_nan=False)
