"""What scripts/ are told is judged before any work: a wrong word is one line, and --help changes nothing."""

import os
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
COMMANDS = sorted(path.name for path in (ROOT / "scripts").glob("*.py") if "__main__" in path.read_text())


@pytest.fixture
def script(monkeypatch, capsys):
    """Return a function that runs a script in this process; it returns the exit status, stdout and stderr."""
    modules, environment = set(sys.modules), dict(os.environ)

    def run(name, *words):
        monkeypatch.setattr(sys, "argv", [name, *words])
        monkeypatch.setattr(sys, "path", [str(ROOT / "scripts"), *sys.path])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(ROOT / "scripts" / name), run_name="__main__")
        return ended.value.code, *capsys.readouterr()

    yield run
    os.environ.clear()
    os.environ.update(environment)
    for name in set(sys.modules) - modules:
        if str(ROOT / "scripts") in str(getattr(sys.modules[name], "__file__", "")):
            del sys.modules[name]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_printed_and_an_unknown_option_refused(script, name):
    """`lock.py --help` wrote the file that it should have told of."""
    before = (ROOT / ".ci" / "constraints.txt").read_bytes()
    status, said, _ = script(name, "--help")
    assert not status and said.startswith("usage: ")
    status, _, said = script(name, "--no-such-option")
    assert status == 2 and "error: " in said.splitlines()[-1]
    assert (ROOT / ".ci" / "constraints.txt").read_bytes() == before


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("trust_pictures.py", ("{folder}",)),
        ("readme_picture.py", ("image", "camera", "result", "{folder}/none/picture.png")),
        ("calibration.py", ("-n", "0")),
        ("calibration.py", ("--size", "64")),
        ("calibration.py", ("--pool", "{folder}/words")),
        ("benchmark.py", ("--sizes", "large")),
        ("evaluate.py", ("tracking", "--kinds", "flight")),
        ("evaluate.py", ("dynamics", "--kinds", "flight")),
        ("soak.py", ("-n", "-1")),
        ("throughput.py", ("--processes", "0")),
    ],
)
def test_a_wrong_word_is_one_line(script, tmp_path, name, words):
    (tmp_path / "words").write_text("no record\n")
    status, _, said = script(name, *(word.format(folder=tmp_path) for word in words))
    assert status in (1, 2)
    assert said.splitlines()[-1].startswith((f"{name}: error: ", "derender: "))
