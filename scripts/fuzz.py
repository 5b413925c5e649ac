"""Try commands on damaged files, absurd options and in hostile surroundings; tell what was not answered in a line.

Whatever it is given, a command has to end with status 0, 1, 2 or 3, within a while, without a traceback, with one line
of fault under status 1, without control characters on the terminal, and without half of its output left behind.

    python scripts/fuzz.py -n 2000 --first 0          # tries 0 to 1999; --only infer: those whose command says infer
    python scripts/fuzz.py -n 1 --first 1234 -v       # one try again, with what it said

A try is its number: the same number damages the same file in the same way. Exit status 1 where something was found.
"""

import argparse
import contextlib
import copy
import importlib
import io
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import zipfile
from pathlib import Path

import click
import numpy as np
from arguments import at_least_one

from derender.cli import group, status_of

LONGEST = 25  # seconds of CPU for one try: others may be at work on the same machine
LEFT_OUT = 0.1  # share of the tries with absurd options whose last words are missing
PATIENCE = 4 * LONGEST  # seconds of the clock: whoever waits for something that never comes is found too
PRIOR = """derender: 1
camera: {fx: 60, fy: 60, cx: 31.5, cy: 23.5, width: 64, height: 48}
root: {position: [0, 0.1, 0.9], quat_wxyz: [0.5, 0.866, 0, 0]}
objects:
  floor: {shape: plane, contact: {type: 6dof}}
  red:
    shape: {type: cube, side: 0.20}
    mass: 0.4
    parent: floor
    contact: {type: face-to-face, parent_face: +z, child_face: -z, x: 0.02, y: 0.0, theta: 20 deg}
  green:
    shape: {type: box, length: {uniform: [0.05, 0.12]}, width: 0.1, height: {log-normal: [0.1, 0.2]}}
    parent: red
    contact: {type: face-to-face, parent_face: +z, child_face: -z, theta: {uniform: [0, 90 deg]},
              u: {uniform: [0, 1]}, v: 0.5}
likelihood: {type: gaussian, sigma: 5 mm, blur: 1.0}
inference: {chains: 2, draws: 20, warmup: 5}
"""
RESULT = ["posterior.npz", "scene.yaml", "summary.json", "observation.npz", "explained.npy", "simulation.json"]
INFER = "infer {0} --quick -q -o out"
# Commands, and the files of which one is damaged; {cam} and {ext} are one of CAMERAS and of EXPORTS.
CAMERAS, EXPORTS = ("camera.json", "ros.json", "k.txt", "transforms.json"), ("glb", "obj", "xml", "urdf", "json")
TRIES = [
    *((f"infer {name} --camera {{cam}} --quick -q -o out", [name, name, "{cam}"])
      for name in ("image.png", "image.npy", "image.tiff", "image.exr", "image.npz")),
    ("infer image.npy --confidence conf.png --quick -q -o out", ["conf.png"]),
    ("infer image.npz --known known.yaml --quick -q -o out", ["known.yaml", "mesh.obj"]),
    ("infer image.npz --scene prior.yaml --method map -q -o out", ["prior.yaml"]),
    ("infer image.npz --scene prior.yaml -q -o out --draws 10 --warmup 3 -j 1", ["prior.yaml"]),
    ("infer image.npz --scene mesh.yaml --method map -q -o out", ["mesh.yaml", "mesh.obj", "mesh.stl"]),
    ("infer image.png image2.png --together --poses poses.json --camera camera.json --quick -q -o out", ["poses.json"]),
    ("infer image.png image2.png --together --camera transforms.json --quick -q -o out", ["transforms.json"]),
    ("infer film --track --fps 30 --camera camera.json -o out -q", ["film/frame_000.npy", "film/frame_001.npy"]),
    ("infer film --track --dynamics --prior dynamics.yaml --camera camera.json -o out -q", ["dynamics.yaml"]),
    ("infer image.bag --quick -q -o out", ["image.bag"]),
    ("simulate scene.yaml --duration 0.05 --engine both -q", ["scene.yaml"]),
    ("simulate mesh.yaml --duration 0.05 --settle out.yaml", ["mesh.yaml", "mesh.obj", "mesh.stl"]),
    ("simulate prior.yaml --duration 0.05 --draws 3 --engine statics --json", ["prior.yaml"]),
    ("simulate result --duration 0.05 --draws 3 --margin --forces --engine both", [f"result/{n}" for n in RESULT]),
    ("simulate scene.yaml --duration 0.05 --settle out.yaml --tilt 10deg --push red:+x:0.5N@0.01s", ["scene.yaml"]),
    ("look result --json -o out.json", [f"result/{n}" for n in RESULT[:4]]),
    ("view result --no-open", [f"result/{n}" for n in (*RESULT, "report.html")]),
    ("view track --no-open", ["track/track.json", "track/track.npz", "track/report.html"]),
    ("eval result truth.json --json", ["result/posterior.npz", "result/scene.yaml", "truth.json"]),
    ("eval scene.yaml truth.json -v", ["scene.yaml", "truth.json"]),
    ("calibrate bare --camera camera.json -o out.yaml", ["bare/frame_001.npy", "camera.json"]),
    *((f"show {name}", [name]) for name in ("scene.yaml", "prior.yaml", "mesh.yaml")),
    *((f"show {name} --json", [f"{name}/{n}" for n in RESULT[:3]]) for name in ("result", "given")),
    ("score scene.yaml image.npz --json", ["scene.yaml", "image.npz"]),
    ("score result", ["result/posterior.npz", "result/observation.npz", "result/scene.yaml"]),
    ("score prior.yaml image.png --camera camera.json", ["prior.yaml", "image.png", "camera.json"]),
    *((f"report {name} -o out", [f"{name}/{n}" for n in RESULT]) for name in ("result", "given")),
    ("report result given", ["given/posterior.npz", "result/posterior.npz"]),
    *((f"export {name} -o out.{{ext}}", files)
      for name, files in (("result", ["result/posterior.npz", "result/scene.yaml"]), ("scene.yaml", ["scene.yaml"]))),
    ("render scene.yaml -o out.png --camera ros.json", ["scene.yaml", "ros.json"]),
    ("render mesh.yaml --preview -o out.png", ["mesh.yaml", "mesh.obj", "mesh.stl"]),
    ("render scene.yaml --noise -o out.npz", ["scene.yaml"]),
    ("sample prior.yaml -n 2 -o out --noise", ["prior.yaml"]),
]  # fmt: skip
TEXTS = re.split(
    r"  |\n",
    """9999999999999999999999  1_000  ٣  ½  0o17  2026-01-01  !!binary aGk=  <<: *a  ?  |  >  +1  1e  --
!!float x  {uniform: [nan, 1]}  {categorical: {floor: 0.5, red: 0.5}}  {categorical: {}}  {poisson: 1e9}  {mixture: []}
{beta: [1e-9, 1e-9]}  {von-mises: [0, 1e9]}  5 kg  1e-320  0.1.2  [0, 0, 0, 0]  [1e200, 1e200, 1e200]  nan  .nan  inf
-1  0  1e308  1e-308  -0.0  ''  null  []  {}  [[1]]  true  \u202e  ~  !!python/object:os.system x  &a [*a]  1e400  abc
floor  red  -.inf  1:30  0x1F  3 mm  30 deg  1 furlong  {uniform: [1, 0]}  {uniform: [0, 0]}  {normal: [0, -1]}
{uniform: []}  {log-normal: [0.1, 0]}""",
)
TREES = ["HUGE", 1e-320, "\ud800", {"": 0}, {"a": {"a": []}}, [[[[[]]]]], None, True, -1, 0, 1e308, 1e-308,
         float("nan"), float("inf"), 10**30, "", "x", "floor", "\x00", "x" * 300, [], {}, [1, 2, 3], [None], -1e-300,
         0.5, [float("nan")] * 4, [[0] * 4] * 4, "1e400", "../../etc/passwd"]  # fmt: skip
WORDS = ["", "nan", "inf", "-1", "0", "1", "2", "1e308", "1e-308", "abc", "floor", "red", "red:+x:infN", "red:+q:1N@1s",
         ":::", "nobody", "-10deg", "1e9deg", "2mm,1deg", "2mm", "mm", "200%", "0%", "0.01s", "9" * 23, "scene.yaml",
         "result", "image.npz", "image.png", "camera.json", "known.yaml", "poses.json", "film", "nothing", "/dev/null",
         "/", "..", "a\x00b", "\u202e", "x" * 3000, "auto", "none", "0,0,1,0", "nan,nan,nan,nan", "1,2", "-y", "0,0,0",
         "inf,0,0", "box,box", "cube,teapot", "kinect", "statics", "both", "box:0.1,0.1,0.1@red", "2Hz", "5Hz:2cm",
         "red@0.1s", "x.glb", "x.zzz", "x.xml", "s.yaml", "x.csv", "tcp://127.0.0.1:1", "nope.json"]  # fmt: skip


def make_inputs(folder: Path) -> None:
    """Write the files that tries damage: small ones of every kind that a command reads."""
    import trimesh

    import derender
    from derender.camera.depth_file import write_depth

    os.chdir(folder)
    Path("prior.yaml").write_text(PRIOR)
    run("sample prior.yaml --seed 4 -q".split())
    os.rename("sample_000.yaml", "scene.yaml")
    os.rename("sample_000.npz", "image.npz")
    image = derender.read_depth("image.npz")
    film = [f"film/frame_00{k}.npy" for k in range(3)]
    for name in ("image.npy", "image.png", "image2.png", "image.tiff", "image.exr", *film):
        write_depth(name, image.depth, image.camera)
    rng = np.random.default_rng(0)
    for k in range(3):
        write_depth(f"bare/frame_00{k}.npy", 1.0 + rng.normal(size=image.depth.shape) * 0.002, image.camera)
    write_depth("conf.png", np.full(image.depth.shape, 0.002), image.camera)
    eye, matrix = np.eye(4).tolist(), [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0]
    frames = [{"file_path": name, "transform_matrix": eye} for name in ("image.png", "image2.png")]
    trees = {
        "camera.json": {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "width": 64, "height": 48},
        "ros.json": {"K": matrix, "width": 64, "height": 48, "gravity": [0, 9.8, 1.0], "depth_scale": 1.0},
        "transforms.json": {"w": 64, "h": 48, "fl_x": 60.0, "fl_y": 60.0, "cx": 31.5, "cy": 23.5, "frames": frames},
        "poses.json": [eye, eye],
    }
    for name, tree in trees.items():
        Path(name).write_text(json.dumps(tree))
    np.savetxt("k.txt", np.reshape(matrix, (3, 3)))
    Path("image.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(range(256)) * 8)
    Path("dynamics.yaml").write_text("dynamics: {friction: {uniform: [0.1, 0.5]}, restitution: 0.3}\n")
    Path("known.yaml").write_text("known:\n  brick: {type: box, length: 20 cm, width: 10 cm, height: 6 cm}\n"
                                  "  tool: {type: mesh, file: mesh.obj}\n")  # fmt: skip
    mesh = trimesh.creation.icosphere(1, 0.05)
    mesh.export("mesh.obj")
    mesh.export("mesh.stl")
    text = Path("scene.yaml").read_text().replace("{type: cube, side: 0.2}", "{type: mesh, file: mesh.obj}")
    Path("mesh.yaml").write_text(text)
    Path("stl.yaml").write_text(text.replace("mesh.obj", "mesh.stl"))
    for words in ("infer image.npz -q -o result", "simulate result --duration 0.05 --draws 5 -q",
                  "infer image.npz --scene prior.yaml -q -o given", "simulate given --duration 0.05 --draws 3 -q",
                  "infer film --track --fps 30 --camera camera.json -q -o track"):  # fmt: skip
        status, _, err, trace = run(words.split(), limited=False)
        if status:
            sys.exit(f"the inputs cannot be made: derender {words}: status {status} {err}{trace}")
    Path("truth.json").write_text(run("show scene.yaml --json".split())[1])


def run(words: list[str], limited: bool = True) -> tuple[int | None, str, str, str]:
    """Run a command in this process; return its status, stdout, stderr, and the traceback where it ended with one.

    limited : whether it may take only so long.
    """
    out, err, trace, status = io.StringIO(), io.StringIO(), "", None

    def late(number, frame):
        raise TimeoutError(f"not done after {LONGEST} s of CPU, or {PATIENCE} s of the clock")

    limits = {signal.ITIMER_PROF: LONGEST, signal.ITIMER_REAL: PATIENCE} if limited else {}
    signal.signal(signal.SIGPROF, late)
    signal.signal(signal.SIGALRM, late)
    for timer, seconds in limits.items():
        signal.setitimer(timer, seconds)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = status_of(lambda: group.main(args=words, prog_name="derender", standalone_mode=False))
    except SystemExit as leaving:
        status = int(leaving.code or 0)
    except BaseException:
        trace = traceback.format_exc()
    finally:
        for timer in limits:
            signal.setitimer(timer, 0)
    return status, out.getvalue(), err.getvalue(), trace


# ---- damage, by the kind of file ----


def damaged_tree(r: random.Random, data: bytes) -> bytes:
    """Change places of a JSON tree."""
    tree = json.loads(data)

    def places(node):
        for key in list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            yield node, key
            yield from places(node[key])

    for _ in range(r.choice([1, 1, 2])):
        node, key = r.choice(list(places(tree)) or [({"": tree}, "")])
        kind = r.random()
        if kind < 0.2:
            del node[key]
        elif kind < 0.3 and isinstance(node, list):
            node.insert(key, copy.deepcopy(node[key]))
        elif kind < 0.4 and isinstance(node[key], int | float):
            node[key] *= r.choice([-1, 0, 1e3, 1e-3, 1e9, 2])
        else:
            node[key] = r.choice(TREES)
    return json.dumps(tree).replace('"HUGE"', "1" + "0" * 4400).encode()  # more digits than Python reads


def damaged_text(r: random.Random, data: bytes) -> bytes:
    """Change a number, a word, a line or a character of a text."""
    text, kind = data.decode("utf-8", "replace"), r.random()
    lines = text.split("\n")
    if kind < 0.6:
        found = list(re.finditer(r"-?\d+\.?\d*(e-?\d+)?" if kind < 0.4 else r"[A-Za-z][\w-]+", text))
        if found:
            spot, others = r.choice(found), [] if kind < 0.4 else [each[0] for each in found]
            text = text[: spot.start()] + r.choice(TEXTS + others) + text[spot.end() :]
    elif kind < 0.8:
        n = r.randrange(len(lines))
        lines[n : n + 1] = [] if kind < 0.7 else [lines[n], r.choice(lines)]
        text = "\n".join(lines)
    else:
        n = r.randrange(len(text) + 1)
        text = text[:n] + r.choice([*"{}[]:\"'\t\n\x00&*!%\ufeff", "- "]) + text[n:]
    return text.encode("utf-8", "surrogatepass")


def damaged_bytes(r: random.Random, data: bytes) -> bytes:
    """Flip, cut off, put in, or replace."""
    kind, array = r.random(), bytearray(data)
    if kind < 0.5:
        for _ in range(r.choice([1, 3, 20])):
            array[r.randrange(len(array))] = r.randrange(256)
    elif kind < 0.75:
        del array[r.randrange(len(array)) :]
    elif kind < 0.9:
        n = r.randrange(len(array))
        array[n:n] = r.randbytes(r.choice([1, 50]))
    else:
        array = bytearray(r.choice([b"", b"\x00", b"PK\x03\x04", b"\x89PNG\r\n\x1a\n", b"hello"]))
    return bytes(array)


def damaged_array(r: random.Random, array: np.ndarray) -> np.ndarray:
    """Change an array's shape, type or numbers."""
    if array.dtype.kind in "US" or (array.dtype == np.uint8 and array.ndim == 1):
        text = str(array).encode() if array.dtype.kind in "US" else array.tobytes()
        with contextlib.suppress(ValueError):
            text = damaged_tree(r, text)
        return np.array(text.decode()) if array.dtype.kind in "US" else np.frombuffer(text, np.uint8)
    one = array.astype(float)
    if one.size:
        one.flat[r.randrange(one.size)] = r.choice([np.nan, np.inf, -1, 1e308, 0, 1e-300])
    return r.choice([
        array.reshape(-1), array[None], array[:0] if array.ndim else np.zeros(0), np.full(array.shape, np.nan), one,
        one, np.array("abc"), array.astype(complex), np.array([{}], dtype=object), -one, one * 1e30,
        one * 1e-30, array.astype(np.int8), array.T, array.astype(">f8"), np.zeros_like(array),
        np.stack([array] * 3, -1),
        np.zeros(array.shape, [("a", "f4")]), array.astype(np.uint16) * 1000,
    ])  # fmt: skip


def damaged(r: random.Random, path: Path) -> bytes:
    """Return the bytes of a file, changed in a way of its kind or of any."""
    data, suffix = path.read_bytes(), path.suffix
    if r.random() < 0.2:
        return damaged_bytes(r, data)
    if suffix == ".json":
        return damaged_tree(r, data)
    if suffix in (".yaml", ".txt", ".obj"):
        return damaged_text(r, data)
    if suffix not in (".npy", ".npz"):
        return damaged_bytes(r, data)
    with np.errstate(all="ignore"):
        stream = io.BytesIO()
        if suffix == ".npy":
            np.save(stream, damaged_array(r, np.load(path)), allow_pickle=True)
            return stream.getvalue()
        with zipfile.ZipFile(path) as archive:
            arrays = {name[:-4]: np.load(io.BytesIO(archive.read(name))) for name in archive.namelist()}
        name = r.choice(list(arrays))
        arrays[name] = damaged_array(r, arrays[name])
        if r.random() < 0.2:
            del arrays[name]
        np.savez(stream, **arrays)
        return stream.getvalue()


# ---- tries: words of a command, after something was done to the files ----


def damage(r: random.Random, only: str) -> tuple[list[str], str]:
    """Damage one of a command's files."""
    words, files = r.choice([(words, files) for words, files in TRIES if only in words])
    names = {"cam": r.choice(CAMERAS), "ext": r.choice(EXPORTS)}
    path = Path(r.choice(files).format(**names))
    kind = r.random()
    if kind < 0.95:
        path.write_bytes(damaged(r, path))
    else:
        path.unlink()
        if kind < 0.98:
            path.mkdir()
    return words.format(**names).split(), str(path)


def absurd_options(r: random.Random, only: str) -> tuple[list[str], str]:
    """Give a command options with words that were not meant for them, or too few words."""
    words = r.choice([words for words, _ in TRIES if only in words]).format(cam="camera.json", ext="glb").split()
    command = importlib.import_module(f"derender.cli.{words[0]}").command
    for option in r.sample(command.params, min(len(command.params), r.choice([1, 1, 2, 3]))):
        if not isinstance(option, click.Option) or option.name in ("watch", "scheduler", "jobs", "open_page"):
            continue
        words += [r.choice([*option.opts, *option.secondary_opts])]
        words += [] if option.is_flag else [r.choice(WORDS)]
    return words[: r.randrange(1, len(words)) if r.random() < LEFT_OUT else None], ""


SURROUNDINGS = {
    "stdin closed": "{0} <&-", "stdout closed": "{0} >&-", "stderr closed": "{0} 2>&-", "all": "{0} <&- >&- 2>&-",
    "stdout full": "{0} >/dev/full", "stderr full": "{0} 2>/dev/full", "nobody reads": "{0} | true",
    "small files": "ulimit -f 8; {0}", "C locale": "LC_ALL=C PYTHONUTF8=0 {0}", "no home": "HOME=/nowhere {0}",
    "narrow": "COLUMNS=1 {0}",
    "out is a file": "touch out out.png out.json; {0}", "out is full": "ln -s /dev/full out; {0}",
    "out is a folder": "mkdir -p out out.yaml out.json out.png out.glb out.npz; {0}",
    "out is a link to itself": "ln -s out out; {0}", "the folder is gone": "mkdir x; cd x; rmdir ../x; {0}",
}  # fmt: skip


def hostile(r: random.Random, only: str) -> tuple[list[str], str]:
    """Run a command where something of the system is not as it should be."""
    words = r.choice([words for words, _ in TRIES if only in words]).format(cam="camera.json", ext="glb")
    return words.split(), r.choice(list(SURROUNDINGS))


def run_in(surroundings: str, words: list[str]) -> tuple[int | None, str, str, str]:
    """Run a command in a process of its own; what `run` returns."""
    line = SURROUNDINGS[surroundings].format(f"{sys.executable} -P -m derender {' '.join(words)}")
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, errors="replace", timeout=PATIENCE)
    return done.returncode, done.stdout, done.stderr, ""


def fault_of(told: tuple[int | None, str, str, str], silent: bool) -> str:
    """Return what is wrong with how a command ended, "" where nothing is. silent : its stderr was not to be had."""
    status, out, err, trace = told
    faults = [line for line in err.splitlines() if line.startswith("derender: ") and "compiling" not in line]
    if trace or "Traceback" in err:
        return trace or err
    if status not in (0, 1, 2, 3):
        return f"status {status}: {err[-300:]}"
    if status == 1 and len(faults) != 1 and not silent:
        return f"{len(faults)} lines of fault: {err[-500:]}"
    if any(ord(c) < 32 and c not in "\n\t\r\x1b" or c == "\u202e" for c in out + err):
        return f"control characters: {(out + err)!r:.300}"
    if any(word in err for word in ("RuntimeWarning", "invalid value", "divide by zero", "Deprecat", "Exception ign")):
        return f"a warning of the code's own: {err[-300:]}"
    left = [path for path in Path().rglob(".*") if path.name not in (".", "..")]
    return f"left behind: {sorted(map(str, left))}" if left else ""


def main() -> int:
    """Run the tries and return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=at_least_one, default=2000, help="tries")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="begin no other after so many")
    parser.add_argument("--only", default="", help="a part of the command")
    parser.add_argument("-v", action="store_true", help="tell what each said")
    given = parser.parse_args()
    statuses: dict[object, int] = {}
    found: dict[str, int] = {}
    with tempfile.TemporaryDirectory(prefix="derender-fuzz-") as place:
        inputs, work = Path(place, "inputs"), Path(place, "work")
        inputs.mkdir()
        make_inputs(inputs)
        started = time.monotonic()
        for number in range(given.first, given.first + given.n):
            if time.monotonic() - started > given.seconds:
                break
            r = random.Random(number)
            os.chdir(place)
            shutil.rmtree(work, ignore_errors=True)
            shutil.copytree(inputs, work)
            os.chdir(work)
            kind = r.choices([damage, absurd_options, hostile], [0.6, 0.3, 0.1])[0]
            words, about = kind(r, given.only)
            told = run_in(about, words) if kind is hostile else run(words)
            statuses[told[0]] = statuses.get(told[0], 0) + 1
            fault = fault_of(told, about in ("stderr closed", "stderr full", "all"))
            if given.v or fault:
                shown = " ".join(word[:60] for word in words).replace("\x00", "\\0")
                print(f"{number}: {shown}  << {about}\n    status {told[0]} {told[2].strip()[-300:]}", flush=True)
            if fault:
                last = fault.strip().splitlines()[-1][:90]
                if last not in found:
                    print("\n".join(fault.strip().splitlines()[-12:]), flush=True)
                found[last] = found.get(last, 0) + 1
        os.chdir("/")
    seconds = time.monotonic() - started
    print(f"{sum(statuses.values())} tries in {seconds:.0f} s, statuses {statuses}, faults {found or 'none'}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
