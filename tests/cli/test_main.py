"""The command line as a whole: exit statuses, one line for each fault, lazy commands."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import click
import pytest

from derender import __version__, data_path
from derender.cli import COMMANDS, group, main
from derender.cli.options import Talk
from derender.errors import DerenderError


def run(*arguments):
    with pytest.raises(SystemExit) as ended:
        main(list(arguments))
    return ended.value.code


@pytest.fixture
def replaced(monkeypatch):
    """Return a function that puts a callback in place of `derender types`."""

    def replace(callback):
        monkeypatch.setattr(type(group), "get_command", lambda *_: click.Command("types", callback=callback))

    return replace


def raising(error):
    def callback():
        raise error

    return callback


def interrupted_import():
    """End as a module in C does whose loading Ctrl-C has interrupted."""
    raise ImportError("initialization failed") from KeyboardInterrupt()


@pytest.mark.parametrize(
    "outcome, status, line",
    [
        (lambda: None, 0, ""),
        (lambda: 3, 3, ""),
        (
            raising(DerenderError("it is\nbroken", "a.yaml:3", "mend it")),
            1,
            "derender: a.yaml:3: it is broken; mend it\n",
        ),
        (raising(click.UsageError("no")), 2, None),
        (raising(KeyboardInterrupt()), 130, None),
        (raising(MemoryError()), 1, "derender: there is too little memory for it\n"),
        (raising(click.Abort()), 130, None),
        (interrupted_import, 130, "derender: interrupted\n"),
        (raising(PermissionError(13, "Permission denied", "out.npz")), 1, "derender: out.npz: Permission denied\n"),
        (raising(OSError(28, "No space left on device", "x")), 1, "derender: x: No space left on device\n"),
    ],
)
def test_exit_statuses(outcome, status, line, replaced, capsys):
    replaced(outcome)
    assert run("types") == status
    if line is not None:
        assert capsys.readouterr().err == line


def test_a_bug_shows_its_traceback(replaced):
    replaced(raising(ZeroDivisionError("a bug")))
    with pytest.raises(ZeroDivisionError):
        main(["types"])


def test_help_lists_every_command(capsys):
    assert run("--help") == 0
    text = capsys.readouterr().out
    assert all(f"  {name} " in text for name in COMMANDS)
    assert run("-h") == 0


@pytest.mark.parametrize("name", COMMANDS)
def test_help_tells_no_value_of_pythons(name, capsys):
    """Where a number may be any, help said x<=None."""
    assert run(name, "--help") == 0
    assert "None" not in capsys.readouterr().out


def test_version(capsys):
    assert run("--version") == 0
    assert __version__ in capsys.readouterr().out


def test_an_unknown_command_or_option_is_a_usage_fault_with_a_suggestion(capsys):
    assert run("infr") == 2
    assert "did you mean 'infer'" in capsys.readouterr().err
    assert run("doctor", "--no-such") == 2


def test_a_reader_that_goes_away_is_no_fault():
    script = "import sys; from derender.cli import status_of; sys.exit(status_of(lambda: print(100_000 * str(1))))"
    for words in ("-m derender --help", "-m derender types --json", f"-c '{script}'"):
        command = f"{{ {sys.executable} {words}; echo $? >&2; }} | true"
        done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=60)
        assert done.stderr == "0\n"


@pytest.mark.parametrize("target, line", [("/dev/full", "derender: No space left on device"), ("&-", "")])
def test_a_full_or_closed_stdout_is_at_most_one_line(target, line):
    command = f"{sys.executable} -m derender --help >{target}"
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, timeout=60)
    assert done.stderr.strip() == line


def test_what_stderr_does_not_take_costs_nothing(tmp_path):
    command = f"{sys.executable} -m derender sample 2>/dev/full"
    assert subprocess.run(["sh", "-c", command], cwd=tmp_path, timeout=60).returncode == 0
    assert (tmp_path / "sample_000.npz").exists()


@pytest.mark.parametrize("name", ["infer", "sample"])
def test_a_folder_has_not_the_name_of_a_file(name, capsys, tmp_path, monkeypatch):
    """`derender sample -o scene.npz` made a folder of that name."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main([name, "tabletop", "-o", "scene.npz"])
    assert ended.value.code == 2 and "scene.npz is the name of a file" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["calibrate", "export", "infer", "look", "render", "report", "sample", "simulate"])
def test_an_output_without_a_name_is_a_usage_fault(name, capsys):
    with pytest.raises(SystemExit) as ended:
        main([name, "x", "-o", ""])
    assert ended.value.code == 2 and "'-o' / '--output': it is empty" in capsys.readouterr().err


def listen():
    """Let the new process hear interrupts, also where a shell has started the tests in the background, deaf to them."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def test_an_interrupt_ends_with_130_and_one_line(tmp_path):
    command = [sys.executable, "-m", "derender", "sample", "free", "-n", "1000000", "-o", "-"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path,
                               preexec_fn=listen)  # fmt: skip
    assert process.stdout is not None
    process.stdout.read(1000)  # it is at work
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert error.decode().strip().splitlines()[-1] == "derender: interrupted" and b"Traceback" not in error


def test_talk_keeps_to_its_level(capsys):
    for level, expected in ((-1, "warning: c\n"), (0, "a\nwarning: c\n"), (1, "a\nb\nwarning: c\n")):
        talk = Talk(level)
        talk.say("a")
        talk.detail("b")
        talk.warn("c")
        captured = capsys.readouterr()
        assert captured.err == expected and not captured.out


def test_a_name_that_steers_a_terminal_does_not_reach_it(capsys):
    Talk().say("wrote red\x1b[31m\u202e/\nand more")
    assert capsys.readouterr().err == "wrote red\\x1b[31m\\u202e/\nand more\n"


def test_what_an_encoding_lacks_is_a_question_mark():
    process = subprocess.run(
        [sys.executable, "-m", "derender", "show", data_path("scenes/figure-3-free.yaml")],
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "cp1252", "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert process.returncode == 0 and b"?? floor" in process.stdout


def test_a_name_that_is_no_text_is_told(capsys):
    assert run("infer", os.fsdecode(b"a\xff.npz")) == 1
    assert (
        capsys.readouterr().err
        == "derender: a\\udcff.npz: this name is not UTF-8; rename it: results tell it in text\n"
    )


def test_doctor_says_what_works(capsys):
    assert run("doctor", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["renderers"]["raycast"] == {"works": True, "fault": None, "remedy": None}
    assert report["versions"]["derender"] == __version__
    for entry in report["renderers"].values():
        assert entry["works"] or (entry["fault"] and "apt-get install" in entry["remedy"])


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams_do_no_harm(tmp_path, closed):
    command = f"{sys.executable} -m derender sample --no-images --seed 1 -o out {closed}"
    done = subprocess.run(
        ["sh", "-c", command],
        cwd=tmp_path,
        timeout=60,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    assert done.returncode == 0
    scene = (tmp_path / "out" / "sample_000.yaml").read_text()
    assert "derender: 1" in scene and "wrote" not in scene
