"""The cache of compiled functions: never stale, anywhere, for any number of processes."""

import contextlib
import hashlib
import multiprocessing
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import derender
from derender.atomic import fcntl
from derender.compilation import cache, entries
from derender.compilation.cache import Kernel, njit
from derender.compilation.entries import is_private, read_entry

PACKAGE = Path(derender.__file__).parent

PROBE = """
import sys

from derender.answer import ANSWER  # a constant: numba alone would go on returning the old one
from derender.compilation.cache import njit

@njit(cache=True, nogil=True)
def inner(x):
    return x + ANSWER

@njit(cache=True, nogil=True)
def kernel(x):
    return inner(x)

if __name__ == "__main__":
    print(kernel(1), "numba" not in sys.modules)
"""


WARM = """
import sys
from typing import NamedTuple

import numpy as np

from derender.compilation.cache import njit

class Pair(NamedTuple):
    values: np.ndarray
    factor: float

@njit(cache=True, nogil=True)
def kernel(rng, pair, more):
    if pair.factor < 0.0:
        raise ValueError("a negative factor")
    return pair.factor * pair.values + more, rng.random(), (len(pair.values), more > 1.0)

def told(*arguments):
    try:
        return repr(kernel(np.random.default_rng(1), *arguments)).replace(" ", "")
    except Exception as fault:
        return type(fault).__name__ + str(fault).replace(" ", "")

if __name__ == "__main__":
    values = np.arange(3.0)
    for given in (Pair(values, 2.0), Pair(values, -1.0), Pair(values[::2], 2.0), Pair(np.float32(values), 2.0)):
        print(told(given, 0.5), told(given, 1))
    print("numba" in sys.modules)
"""


@pytest.fixture
def package(tmp_path):
    """A small package named derender, with the real cache module and one kernel that uses another file's constant."""
    folder = tmp_path / "derender"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    shutil.copytree(PACKAGE / "compilation", folder / "compilation", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("atomic.py", "errors.py"):
        shutil.copy(PACKAGE / name, folder)
    (folder / "answer.py").write_text("ANSWER = 41\n")
    (folder / "probe.py").write_text(PROBE)
    return folder


def start(package, **environment):
    clean = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    return subprocess.Popen(
        [sys.executable, "-m", "derender.probe"],
        cwd=package.parent,
        text=True,
        env={**clean, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def run(package, **environment):
    process = start(package, **environment)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    return out.split(), err


def test_compiles_once_says_so_once_and_notices_a_constant_elsewhere(package):
    out, err = run(package)
    assert out == ["42", "False"] and err.count("compiling kernels") == 1
    out, err = run(package)
    assert out == ["42", "True"] and err == ""
    entries = list(package.glob("__pycache__/*.run"))
    assert len(entries) == 1  # inner is compiled into it
    (package / "answer.py").write_text("ANSWER = 1\n")
    assert run(package)[0] == ["2", "False"]
    assert not any(entry.exists() for entry in entries)  # stale entries are deleted


OTHER = """
from typing import NamedTuple
import numpy as np
from derender.compilation.cache import njit

TABLE = np.array([1.0, 2.0])

class Pair(NamedTuple):
    first: int
    second: int

@njit(cache=True, nogil=True)
def other(x):
    \"\"\"Say something.\"\"\"
    return x + 1
"""
CALLS = PROBE.replace("return inner(x)", "return inner(other(x)) + Pair(1, 20).first + int(TABLE[1])")
CALLS = CALLS.replace("from derender.answer", "from derender.other import TABLE, Pair, other\nfrom derender.answer")


def test_a_change_of_what_is_compiled_in_is_noticed_and_one_of_words_is_not(package):
    """By a source file's digest a comment cost as much as a change of the code."""

    def changed(old, new):
        text = (package / "other.py").read_text()
        assert old in text
        (package / "other.py").write_text(text.replace(old, new))
        # Python takes a file of the same size, written within the same second, for the one that it has as bytecode.
        return run(package, PYTHONDONTWRITEBYTECODE="1")[0]

    (package / "probe.py").write_text(CALLS)
    (package / "other.py").write_text(OTHER)
    assert run(package, PYTHONDONTWRITEBYTECODE="1")[0] == ["46", "False"]
    assert changed("Say something.", "Say something else.\n") == ["46", "True"]
    assert changed("x + 1", "x + 2  # no longer 1") == ["47", "False"]
    assert changed("2.0", "12.0") == ["57", "False"]
    assert changed("first: int\n    second", "second: int\n    first") == ["76", "False"]


def test_what_only_numba_can_make_is_known_by_its_name_and_its_file():
    """Two of one file under each other's names would have been taken for what they were."""
    more, less = cache.late("derender.render.raycast.lanes", "add", "subtract")
    assert cache.told(more) != cache.told(less) != cache.told(cache.Late("derender.errors", "subtract"))


def test_the_first_of_many_processes_says_that_it_compiles(monkeypatch, capsys):
    """The first batch on a machine once said nothing for as long as a minute."""
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: multiprocessing.current_process())
    for name, told in (("SpawnProcess-1", 1), ("SpawnProcess-2", 0)):
        monkeypatch.setattr(multiprocessing.current_process(), "_name", name)
        cache.announce.__wrapped__()
        assert capsys.readouterr().err.count("compiling kernels") == told


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_a_full_stderr_stops_no_compilation(monkeypatch):
    full = open("/dev/full", "w")  # noqa: SIM115  (closing it fails, as writing does)
    monkeypatch.setattr(sys, "stderr", full)
    cache.announce.__wrapped__()
    monkeypatch.undo()
    with contextlib.suppress(OSError):
        full.close()


def test_what_was_compiled_is_called_without_numba(package):
    """Its answers, faults, arrays, tuples, defaults and random numbers are numba's."""
    (package / "probe.py").write_text(WARM)
    cold, warm = (run(package)[0] for _ in range(2))
    assert cold[-1] == "True" and warm[-1] == "False" and cold[:-1] == warm[:-1]


@pytest.mark.slow
def test_a_folder_of_ones_own_and_a_package_that_cannot_be_written(package, tmp_path):
    elsewhere, home = tmp_path / "elsewhere", tmp_path / "home"
    assert run(package, NUMBA_CACHE_DIR=str(elsewhere))[0] == ["42", "False"]
    assert list(elsewhere.rglob("*.run")) and not list(package.rglob("*.run"))
    shutil.rmtree(package / "__pycache__", ignore_errors=True)
    (package / "__pycache__").write_text("a file where the folder would be: not even root can write into it")
    for hit in ("False", "True"):
        assert run(package, XDG_CACHE_HOME=str(home), LOCALAPPDATA=str(home), HOME=str(home))[0] == ["42", hit]
    assert list(home.rglob("*.run"))


@pytest.mark.slow
def test_where_nothing_can_be_written_it_compiles_each_time(package, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    shutil.rmtree(package / "__pycache__", ignore_errors=True)
    (package / "__pycache__").write_text("")
    broken = dict.fromkeys(("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA", "HOME"), str(blocked))
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    if hasattr(os, "getuid"):
        digest = hashlib.sha256(str(package).encode()).hexdigest()[:16]
        (temporary / f"derender-{os.getuid()}-{digest}").symlink_to(tmp_path)  # somebody else's trap: not used
    for _ in range(2):
        assert run(package, TMPDIR=str(temporary), **broken) == (["42", "False"], "")  # nor is it said that it is kept


def test_processes_that_start_together_do_not_harm_each_other(package):
    """One of them compiles, the others wait for it."""
    processes = [start(package) for _ in range(4)]
    loaded = []
    for process in processes:
        out, err = process.communicate(timeout=240)
        assert process.returncode == 0 and out.split()[0] == "42", err
        loaded.append(out.split()[1])
    assert sorted(loaded) == (["False", "True", "True", "True"] if fcntl else sorted(loaded))
    assert run(package)[0] == ["42", "True"]
    assert not list(package.rglob(".*.run")) and not list(package.rglob("*.lock"))


def test_what_cannot_be_compiled_is_nobodys_turn_any_more(package):
    (package / "probe.py").write_text(
        PROBE.split("if __name__")[0]
        + """
import pathlib
try:
    kernel(())
except Exception as error:
    print(type(error).__name__, list(pathlib.Path(".").rglob("*.lock")))
"""
    )
    assert run(package)[0] == ["TypingError", "[]"]


@pytest.mark.slow
def test_a_process_that_dies_while_it_compiles_holds_up_nobody(package):
    (package / "probe.py").write_text(
        PROBE.replace(
            "def inner",
            """def slow(x):
    return x


import os
from derender.compilation import entries

if os.environ.get("DIE"):
    entries.write_entry = lambda *_: os._exit(9)


@njit(cache=True, nogil=True)
def inner""",
        )
    )
    process = start(package, DIE="1")
    process.communicate(timeout=120)
    assert process.returncode == 9
    assert run(package)[0] == ["42", "False"]


@pytest.mark.slow
def test_what_was_loaded_can_be_compiled_into_another(package):
    (package / "probe.py").write_text(
        PROBE.replace(
            "print(kernel(1)",
            """import os
    print((inner if os.environ.get("INNER") else kernel)(1)""",
        )
    )
    assert run(package, INNER="1")[0] == ["42", "False"]
    assert run(package)[0] == ["42", "False"]  # inner is compiled again, into kernel
    assert run(package)[0] == ["42", "True"]


def test_every_kernel_of_the_package_uses_this_cache():
    for source in Path(derender.__file__).parent.rglob("*.py"):
        if source.parts[-2:] != ("compilation", "compiler.py"):
            assert "from numba import njit" not in source.read_text(), source


FACTORY = """
import sys
import numpy as np
from derender.compilation.cache import njit

def make(factor):
    @njit(cache=True)
    def scaled(x):  # too long to be compiled into its callers
        total = 0.0
{loops}
        return total
    return scaled

once, twice = make(1), make(2)

@njit(cache=True)
def first(x):
    return once(x) + once(2.0 * x)

@njit(cache=True)
def second(x):
    return twice(x) + twice(2.0 * x)

if __name__ == "__main__":
    print(*(globals()[name](np.ones(2)) for name in sys.argv[1:]))
"""
LOOP = """
        for i in range({k}, x.size, 2):
            total += factor * np.sqrt(x[i]) + {k} * x[i - 1]"""
LOOPS = "".join(LOOP.format(k=k) for k in range(40))


@pytest.mark.slow
def test_closures_compiled_by_different_processes_are_told_apart(package):
    (package / "probe.py").write_text(FACTORY.format(loops=LOOPS))

    def answers(*names):
        process = subprocess.run([sys.executable, "-m", "derender.probe", *names], cwd=package.parent, text=True,
                                 capture_output=True, check=True)  # fmt: skip
        return process.stdout.split()

    alone = answers("first") + answers("second")
    assert alone[0] != alone[1]
    assert answers("first", "second") == alone


@njit
def assign(target, source):
    target[0, :2] = source


def test_an_array_of_another_shape_is_not_assigned_to_a_slice():
    target = np.zeros((2, 3))
    assign(target, np.ones(2))
    assert target.tolist() == [[1.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
    with pytest.raises(ValueError, match="an array of another shape"):
        assign(target, np.ones(3))


def test_a_closure_that_holds_what_has_no_name_is_refused():
    held = object()

    def closure():
        return held

    with pytest.raises(TypeError, match="numbers and words"):
        njit(closure)


# ---- damage ----


def tiny():
    """Return a kernel of one line."""
    return Kernel(lambda x: x + 1, True, {})


@pytest.fixture
def entry(tmp_path, monkeypatch):
    """The entry of a kernel of one line, and what it holds."""
    monkeypatch.setattr(entries, "_folder", lambda: tmp_path)
    assert tiny()(1) == 2
    (path,) = tmp_path.glob("*.run")
    return path, path.read_bytes()


def damaged(rng, content, number):
    """Return a file's bytes after an accident."""
    kind = number % 5
    if kind == 0:  # cut off
        return content[: rng.integers(len(content))]
    if kind == 1:  # bits flipped
        array = np.frombuffer(content, np.uint8).copy()
        places = rng.integers(len(array), size=rng.integers(1, 9))
        array[places] ^= rng.integers(1, 256, size=len(places)).astype(np.uint8)
        return content if array.tobytes() == content else array.tobytes()
    if kind == 2:
        return b""
    if kind == 3:  # written over by nothing
        start = rng.integers(len(content))
        return content[:start] + bytes(len(content) - start)
    return rng.bytes(int(rng.integers(1, 2 * len(content))))


def test_broken_entries_are_deleted_and_never_run(entry):
    path, content = entry
    rng = np.random.default_rng(5)
    for number in range(1000):
        broken = damaged(rng, content, number)
        path.write_bytes(broken)
        if broken != content:
            assert read_entry(path) is None and not path.exists(), number


def test_a_kernel_with_a_broken_entry_is_compiled_again(entry):
    path, content = entry
    for broken in (content[:-1], b"", content[:40] + b"\0" + content[41:]):
        path.write_bytes(broken)
        assert tiny()(1) == 2
        assert read_entry(path) is not None


def test_an_entry_under_another_ones_name_is_none(entry):
    """Such as one of another version or machine, which the name tells."""
    path, content = entry
    other = path.with_name("other.run")
    other.write_bytes(content)
    assert read_entry(other) is None and not other.exists()


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="folders have owners on POSIX alone")
def test_folders_that_others_can_write_to_are_not_used(tmp_path):
    for mode, private in ((0o755, True), (0o700, True), (0o775, False), (0o757, False)):
        tmp_path.chmod(mode)
        assert is_private(tmp_path) == private, oct(mode)
    tmp_path.chmod(0o755)


def test_processes_do_not_run_what_lies_in_the_current_folder(tmp_path):
    (tmp_path / "multiprocessing.py").write_text("open('it-was-run', 'w')\n")
    code = "import sys\nfrom derender.compilation.threads import each_one_of_many\nimport subprocess\n"
    code += "with each_one_of_many(): subprocess.run([sys.executable, '-c', 'import multiprocessing'], check=True)\n"
    code += "import os; assert 'PYTHONSAFEPATH' not in os.environ\n"
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    environment.pop("PYTHONSAFEPATH", None)
    subprocess.run([sys.executable, "-P", "-c", code], cwd=tmp_path, env=environment, check=True, timeout=60)
    assert not (tmp_path / "it-was-run").exists()


INTERRUPTED = """
from derender.compilation import entries
from derender.compilation.cache import njit

@njit(cache=True, nogil=True)
def kernel(x):
    return x + 1.0

if __name__ == "__main__":
    def interrupt(*arguments):
        raise KeyboardInterrupt

    write, entries.write_entry = entries.write_entry, interrupt
    try:
        kernel(1.0)
    except KeyboardInterrupt:
        entries.write_entry = write
    print(kernel(1.0))
"""


def test_ctrl_c_while_an_entry_is_written_leaves_none_without_code(package):
    (package / "interrupted.py").write_text(INTERRUPTED)
    for _ in range(2):
        done = subprocess.run([sys.executable, "-m", "derender.interrupted"], cwd=package.parent, capture_output=True,
                              text=True, check=False)  # fmt: skip
        assert done.returncode == 0 and done.stdout == "2.0\n", done.stderr
