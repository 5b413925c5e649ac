"""A reader never meets half a file."""

import os

import pytest

from derender.atomic import atomic_path, files_together, make_folder, write_text
from derender.errors import DerenderError


def test_writes_and_replaces(tmp_path):
    path = tmp_path / "a.yaml"
    write_text(path, "one")
    write_text(path, "two")
    assert path.read_text() == "two" and os.listdir(tmp_path) == ["a.yaml"]
    assert path.stat().st_mode & 0o400 and not path.stat().st_mode & 0o111


def test_a_fault_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.npz"
    write_text(path, "old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_text("half")
        assert temporary.suffix == ".npz"
        raise RuntimeError
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.npz"]


def test_faults_of_the_place_are_one_line(tmp_path):
    for bad in (tmp_path, "/proc/a.txt", "/proc/missing/a.txt", f"{tmp_path}/a\0b"):
        with pytest.raises(DerenderError) as caught:
            write_text(bad, "x")
        assert "\n" not in str(caught.value)
    (tmp_path / "file").write_text("")
    with pytest.raises(DerenderError, match="the folder cannot be made"):
        make_folder(tmp_path / "file" / "below")
    assert os.listdir(tmp_path) == ["file"]


def test_a_full_disk_is_the_users_fault(tmp_path):
    with pytest.raises(DerenderError, match="No space left"), atomic_path(tmp_path / "a") as temporary:
        with open("/dev/full", "w") as full:
            full.write("x")
        temporary.write_text("x")
    assert os.listdir(tmp_path) == []


def test_a_set_of_files_comes_together_or_not_at_all(tmp_path):
    names = ("a", "b", "c")
    with files_together(tmp_path, names) as place:
        write_text(place / "a", "1")
        write_text(place / "b", "1")
        assert os.listdir(tmp_path) == [place.name]
    write_text(tmp_path / "mine", "kept")
    with pytest.raises(KeyboardInterrupt), files_together(tmp_path, names) as place:
        write_text(place / "a", "2")
        raise KeyboardInterrupt
    assert sorted(os.listdir(tmp_path)) == ["a", "b", "mine"] and (tmp_path / "a").read_text() == "1"
    with files_together(tmp_path, names) as place:  # nothing of the former set stays
        write_text(place / "a", "3")
        write_text(place / "c", "3")
    assert sorted(os.listdir(tmp_path)) == ["a", "c", "mine"] and (tmp_path / "a").read_text() == "3"
    (tmp_path / "b").mkdir()
    with pytest.raises(DerenderError, match="this is a folder"), files_together(tmp_path, names) as place:
        write_text(place / "a", "4")
    assert (tmp_path / "a").read_text() == "3"
