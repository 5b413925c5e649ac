"""The house rules that a test can hold: imports point one way, --help is quick, the README names everything."""

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import click
import pytest

from derender.cli import COMMANDS, group

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "derender"
README = ROOT / "README.md"
# A room may import itself and the rooms before it. Single files at the top of the package stand before all folders,
# except `document`, which knows scenes, cameras and likelihoods, and `workflow`, which tells the story of `infer`.
ROOMS = (
    "", "compilation", "scene", "camera", "render", "document", "sampling", "results", "posterior", "detection",
    "structures", "physics", "dynamics", "evaluation", "report", "tracking", "workflow", "interface", "batch", "cli",
)  # fmt: skip
HEAVY = {"arviz", "llvmlite", "matplotlib", "mujoco", "networkx", "numba", "numpy", "OpenEXR", "OpenGL", "pandas"}
HEAVY |= {"PIL", "pyrender", "scipy", "trimesh", "yaml"}


def room(module):
    """Return the index in ROOMS of a module derender.x.y."""
    parts = module.split(".")
    return ROOMS.index(parts[1]) if len(parts) > 1 and parts[1] in ROOMS else 0


@functools.cache
def imports(path):
    """Return (line, module) of every import in a file, those inside functions too."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}:{node.lineno}: import by the full name"
            found += [(node.lineno, f"{node.module}.{alias.name}") for alias in node.names]
    return found


FILES = sorted(PACKAGE.rglob("*.py"))


def name_of(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def test_readme_lists_the_rooms_in_an_order_in_which_imports_point_back():
    laid_out = README.read_text().split("## How the code is laid out")[1].split("\n## ")[0]
    rows = [re.findall(r"([a-z_]+)(?:/|\.py)", line.strip().split("  ")[0]) for line in laid_out.splitlines()
            if line.startswith("    ")]  # fmt: skip
    listed = {name: number for number, row in enumerate(rows) for name in row if name != "derender"}
    rooms = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").exists()}
    assert rooms <= set(listed), f"README does not say what is in {sorted(rooms - set(listed))}"
    back = {(name_of(path).split(".")[1], module.split(".")[1]) for path in FILES if path.parent != PACKAGE
            for _, module in imports(path) if module.startswith("derender.")}  # fmt: skip
    wrong = sorted(f"{one} imports {other}" for one, other in back & {(a, b) for a in listed for b in listed}
                   if listed[one] < listed[other])  # fmt: skip
    assert not wrong, wrong


def test_imports_point_from_later_rooms_to_earlier():
    wrong = []
    for path in FILES:
        name = name_of(path)
        if name in ("derender.__main__", "derender"):
            continue
        for line, module in imports(path):
            if module.split(".")[0] == "derender" and room(module) > room(name):
                wrong.append(f"{path.relative_to(ROOT)}:{line} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_neither_package_nor_tests_import_scripts_and_scripts_import_no_tests():
    """What two of them need is in the package, or in scripts/worlds/; what a script does is seen by running it, with
    what lies beside it and nothing else on its path."""
    scripts = {path.stem for path in (ROOT / "scripts").glob("*.py")}
    tests = {path.stem for path in (ROOT / "tests").rglob("*.py")}
    assert {"evaluate", "mutate"} <= scripts
    wrong = []
    for folder, forbidden in (
        ("derender", scripts | tests | {"worlds"}),
        ("tests", scripts),
        ("scripts", tests),
        ("scripts/worlds", scripts | tests),
    ):
        for path in sorted((ROOT / folder).rglob("*.py")):
            if folder == "scripts" and "sys.path" in path.read_text():
                wrong.append(f"{path.relative_to(ROOT)} changes sys.path")
            for line, module in imports(path):
                parts = module.split(".")
                if parts[0] in forbidden | {"scripts", "tests"}:
                    wrong.append(f"{path.relative_to(ROOT)}:{line} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_the_check_above_sees_a_wrong_import():
    """Its broken twin: an import of cli in scene would be seen, inside a function too."""
    tree = "def f():\n    from derender.cli import main\n"
    node = next(node for node in ast.walk(ast.parse(tree)) if isinstance(node, ast.ImportFrom))
    assert room(f"{node.module}.main") > room("derender.scene.pose")


def test_pyrender_and_mujoco_are_imported_in_one_place_each():
    places: dict[str, set[str]] = {"pyrender": set(), "OpenGL": set(), "mujoco": set()}
    for path in FILES:
        for _, module in imports(path):
            if module.split(".")[0] in places:
                places[module.split(".")[0]].add(name_of(path))
    assert places["pyrender"] == places["OpenGL"] == {"derender.render.renderers.opengl"}
    assert all(place.startswith("derender.physics") for place in places["mujoco"])


def run(*arguments, **keywords):
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=60, **keywords)


def test_help_imports_nothing_heavy():
    code = "import sys\nfrom derender.cli import main\ntry: main(['--help'])\nexcept SystemExit: print(*sys.modules)"
    done = run("-c", code)
    loaded = set(done.stdout.splitlines()[-1].split())
    assert done.returncode == 0 and "click" in loaded
    assert not loaded & HEAVY


def test_importing_derender_imports_nothing_heavy():
    done = run("-c", "import sys, derender; print(*sys.modules)")
    assert not set(done.stdout.split()) & HEAVY


def test_the_story_of_infer_imports_no_scipy():
    """Its import takes longer than the search for an easy scene."""
    code = "import sys, derender\nderender.infer(derender.sample('stack', seed=1).render(), method='map')"
    done = run("-c", f"{code}\nprint(*sys.modules)")
    if "numba" in done.stdout.split():  # which compiles what no run before this one did, and imports scipy for that
        done = run("-c", f"{code}\nprint(*sys.modules)")
    loaded = set(done.stdout.split())
    assert "derender.structures.infer" in loaded and "scipy" not in loaded, done.stderr


def commands():
    """Return every command by name."""
    context = click.Context(group)
    return {name: group.get_command(context, name) for name in COMMANDS}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_help_text_is_long_enough_and_shows_a_pipe_or_example(name):
    command = commands()[name]
    text = command.get_help(click.Context(command, info_name=f"derender {name}"))
    assert len(text) > 100
    assert f"derender {name}" in command.help


def test_every_command_and_option_is_in_the_readme():
    text = README.read_text()
    missing = []
    for name, command in commands().items():
        if f"derender {name}" not in text:
            missing.append(f"derender {name}")
        for parameter in command.params:
            for option in parameter.opts if isinstance(parameter, click.Option) else ():
                if option.startswith("--") and option != "--help" and option not in text:
                    missing.append(f"{name} {option}")
    assert not missing, ", ".join(missing)


def test_no_file_is_longer_than_500_lines():
    """STYLE: a file holds one idea, however long; past 500 lines, look again."""
    long = {str(path.relative_to(ROOT)): len(path.read_text().splitlines()) for path in FILES}
    assert not {path: lines for path, lines in long.items() if lines > 500}


def test_nothing_committed_names_this_workplace():
    words = ("/" + "work/", "farm-", "DESIGN" + ".md")
    for path in [*FILES, README, *(ROOT / "scripts").iterdir(), *(ROOT / "data").rglob("*.yaml")]:
        if path.is_file() and path.suffix in (".py", ".md", ".sh", ".yaml", ""):
            text = path.read_text()
            assert not [word for word in words if word in text], path


def test_the_table_of_mutations_fits_the_code():
    """A mutation whose line was rewritten tests nothing: give scripts/mutate.py the new line."""
    command = [sys.executable, str(ROOT / "scripts" / "mutate.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
