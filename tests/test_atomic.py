"""A reader never meets half a file."""

import os
import shutil
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest

from derender import atomic
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
    with pytest.raises(DerenderError, match="this is no file"), files_together(tmp_path, names) as place:
        write_text(place / "a", "4")
    assert (tmp_path / "a").read_text() == "3"


WRITER = """
import sys, time
from pathlib import Path
from derender.atomic import files_together
with files_together(Path(sys.argv[1]), ("a",)) as place:
    (place / "a").write_text("half")
    print("begun", flush=True)
    sys.stdin.read()
    (place / "a").write_text(sys.argv[2])
"""


def writer(folder, text):
    """Return a process that has begun to write, and ends when its stdin is closed."""
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(folder), text], stdin=subprocess.PIPE,
                               stdout=subprocess.PIPE)  # fmt: skip
    assert process.stdout.readline() == b"begun\n"
    return process


def test_what_a_killed_writer_left_goes_and_a_living_ones_stays(tmp_path):
    killed, living = writer(tmp_path, "killed"), writer(tmp_path, "living")
    killed.kill()
    killed.communicate()
    assert len(os.listdir(tmp_path)) == 2
    with files_together(tmp_path, ("a",)) as place:
        write_text(place / "a", "mine")
        assert len(os.listdir(tmp_path)) == 2  # the living one's and this one
    assert (tmp_path / "a").read_text() == "mine"
    living.communicate()
    assert os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_text() == "living"


def test_writers_that_begin_at_once_do_not_take_each_other_for_dead(tmp_path, monkeypatch):
    """One looks for what the dead left whenever another has made its folder and not locked it yet."""
    make, made = atomic.tempfile.mkdtemp, []

    def make_and_look(prefix, dir):
        made.append(make(prefix=prefix, dir=dir))
        if len(made) == 1:
            shutil.rmtree(made[0])
        return made[-1]

    monkeypatch.setattr(atomic.tempfile, "mkdtemp", make_and_look)
    with files_together(tmp_path, ("a",)) as place:
        write_text(place / "a", "whole")
    assert len(made) == 2 and os.listdir(tmp_path) == ["a"] and (tmp_path / "a").read_text() == "whole"


def test_many_writers_at_once_all_end_with_a_whole_set(tmp_path):
    faults = []

    def write(number):
        try:
            for _ in range(20):
                with files_together(tmp_path, ("a", "b")) as place:
                    for name in ("a", "b"):
                        write_text(place / name, str(number))
        except BaseException as error:  # noqa: BLE001  (a thread's would be lost)
            faults.append(error)

    threads = [threading.Thread(target=write, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not faults and sorted(os.listdir(tmp_path)) == ["a", "b"]


def test_a_file_that_cannot_be_written_is_named_as_it_would_have_been_called(tmp_path):
    with pytest.raises(DerenderError) as fault, files_together(tmp_path, ("a",)) as place:
        raise DerenderError("cannot be written: No space left on device", place / "a", "choose another place")
    assert fault.value.where == tmp_path / "a" and os.listdir(tmp_path) == []


def test_the_disk_has_all_files_of_a_set_before_one_of_them_moves(tmp_path, monkeypatch):
    waited, there = [], []
    monkeypatch.setattr(atomic.os, "fsync", lambda number: waited.append(os.fstat(number).st_ino))
    with files_together(tmp_path, ("a", "b")) as place:
        for name in ("a", "b"):
            write_text(place / name, name)
            assert (place / name).exists() and not waited
        inodes = sorted((place / name).stat().st_ino for name in ("a", "b"))
        monkeypatch.setattr(atomic.Path, "replace", lambda path, target: there.append(sorted(waited)))
    assert there == [inodes, inodes]


def test_no_folder_is_left_on_a_full_disk(tmp_path, monkeypatch):
    monkeypatch.setattr("derender.atomic.shutil.disk_usage", lambda path: SimpleNamespace(free=1_000, total=10**9))
    with pytest.raises(DerenderError, match="the disk is full: 0.0 of the 2 MB that are needed"):
        make_folder(tmp_path / "one" / "two", 2_000_000)
    assert not (tmp_path / "one").exists()
    assert make_folder(tmp_path / "one" / "two", 500).is_dir()
    monkeypatch.setattr("derender.atomic.shutil.disk_usage", lambda path: SimpleNamespace(free=0, total=0))
    with pytest.raises(DerenderError, match="nothing can be kept there"):  # as in /proc
        make_folder(tmp_path / "three", 500)
