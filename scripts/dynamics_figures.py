"""Dynamics measured on made films: what `python scripts/evaluate.py dynamics` prints.

    python scripts/evaluate.py dynamics -n 5                          five films of each kind
    python scripts/evaluate.py dynamics -n 5 --keep DIR --kinds slide     in parts: what DIR holds is not done again

Each film is made (sequences.py: MuJoCo at a quarter of a millisecond, with contacts of its own), written to a folder,
and goes through what `derender infer FOLDER --track --dynamics` calls. A number counts as told where track.json has
it; intervals are those of dynamics.npz for every number that the film was made with, told or not. Beside it stands,
where a number is the subject of a film, a peer that is given the TRUE poses and velocities: MuJoCo's own least squares
(mujoco.minimize, which its system identification calls) over rollouts of MuJoCo's own contacts.
"""

import json
import tempfile
import time
from pathlib import Path

import numpy as np
from arguments import names_in
from sequences import KINDS, make_sequence, write_sequence

from derender.atomic import make_folder
from derender.dynamics.result import LEVEL
from derender.errors import DerenderError
from derender.structures.options import Options
from derender.tracking.materials import materials_to_folder
from derender.tracking.run import track_to_folder

GOALS = {
    "friction": "median 3 %, 90 % within 10 %", "restitution": "median .03, all within .1",
    "mass_ratio": "median 8 %, 90 % within 20 %",
}  # fmt: skip
WITHIN = {"friction": 0.10, "restitution": 0.10, "mass_ratio": 0.20}  # relative, but of restitution
FALLS = np.array([0.0, 0.0, -9.81])
# The peer: steps of its rollouts (seconds, MuJoCo's default), where it starts, and within what bounds it looks.
PEER_STEP, PEER_START = 0.002, {"friction": 0.35, "restitution": 0.4, "mass_ratio": 0.0}
PEER_BOUNDS = {"friction": (0.02, 2.0), "restitution": (0.02, 0.98), "mass_ratio": (-2.0, 2.0)}


def names_of(said, truth):
    """Return {name in track.json: true name}, nearest at the first frame."""
    found = {}
    for item in truth["objects"]:
        centre = np.array(item["poses"][0])[:3, 3]
        there = [o for o in said["objects"] if o["poses"][0] is not None and o["name"] not in found]
        if there:
            best = min(there, key=lambda o: np.linalg.norm(np.array(o["poses"][0])[:3, 3] - centre))
            found[best["name"]] = item["name"]
    return found


def intervals_of(path, names):
    """Return {parameter: (median, low, high)} of dynamics.npz; `mass_ratio` as the truth has it, box_2 to box_1."""
    with np.load(path) as file:
        draws = {name: file[name].ravel() for name in file.files if name != "header"}
    result = {}
    for kind in ("friction", "restitution"):  # of things that never meet, each has its own: the one told best
        own = [values for name, values in draws.items() if name.split(".")[0] == kind]
        result[kind] = min(own, key=lambda values: np.std(values) / np.mean(values))
    for name in (name for name in draws if name.startswith("mass_ratio.")):
        of, to = (names.get(part) for part in name.split(".")[1:])
        if {of, to} == {"box_1", "box_2"}:
            result["mass_ratio"] = draws[name] if of == "box_2" else 1 / draws[name]
    edges = [0.5, (1 - LEVEL) / 2, (1 + LEVEL) / 2]
    return {name: [float(x) for x in np.quantile(values, edges)] for name, values in result.items()}


def infer_film(frames, camera, truth, seed):
    """Return what `infer --track --dynamics` says of a film: told names, intervals, seconds."""
    with tempfile.TemporaryDirectory() as place:
        folder, output = Path(place) / "film", Path(place) / "out"
        write_sequence(folder, frames, camera, truth)
        start = time.perf_counter()
        track = track_to_folder([str(folder)], Options(seed=seed), str(output)).track
        tracked = time.perf_counter() - start
        try:
            materials_to_folder(track, output, seed, "evaluate")
        except DerenderError as error:
            return {"told": [], "intervals": {}, "tracking": tracked, "seconds": tracked, "fault": str(error)}
        seconds = time.perf_counter() - start
        said = json.loads((output / "track.json").read_text())
        found = intervals_of(output / "dynamics.npz", names_of(said, truth))
        return {"told": sorted(said["parameters"]), "intervals": found, "tracking": tracked, "seconds": seconds}


def peer(truth):
    """Return what MuJoCo's least squares finds from the true poses: {parameter: value}, and its seconds."""
    import mujoco
    from mujoco import minimize

    names = [name for name in truth["parameters"] if name in PEER_START]
    to_floor = np.linalg.inv(np.array(truth["floor"]))
    poses = np.array([to_floor @ np.array(item["poses"]) for item in truth["objects"]])
    gravity = to_floor[:3, :3] @ truth["gravity"]
    solids = ""
    for k, item in enumerate(truth["objects"]):
        half = " ".join(str(x / 2) for x in item["size"][: 1 if item["type"] == "sphere" else 3])
        solids += f'<body name="b{k}"><freejoint/><geom type="{item["type"]}" size="{half}" density="500"/></body>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{PEER_STEP}" gravity="{" ".join(map(str, gravity))}"/><worldbody>'
        f'<geom type="plane" size="3 3 .1"/>{solids}</worldbody></mujoco>'
    )
    masses, inertias = model.body_mass.copy(), model.body_inertia.copy()
    quaternion, times = np.empty(4), np.arange(poses.shape[1]) / truth["fps"]

    def rollout(values):
        told = dict(zip(names, values, strict=True))
        if "friction" in told:
            model.geom_friction[:, 0] = told["friction"]
        if "restitution" in told:  # the damping ratio of a free spring that gives back so much
            logarithm = np.log(told["restitution"])
            model.geom_solref[:, 0] = -((0.1 / PEER_STEP) ** 2)
            model.geom_solref[:, 1] = 2 * (0.1 / PEER_STEP) * logarithm / np.hypot(np.pi, logarithm)
        ratio = np.exp(told.get("mass_ratio", 0.0))
        model.body_mass[:], model.body_inertia[:] = masses, inertias
        model.body_mass[2:] *= ratio
        model.body_inertia[2:] *= ratio
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        for k, speed in enumerate(truth["speeds"]):
            turn = poses[k, 0, :3, :3]
            mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(turn).ravel())
            data.qpos[7 * k : 7 * k + 7] = [*poses[k, 0, :3, 3], *quaternion]
            data.qvel[6 * k : 6 * k + 3] = to_floor[:3, :3] @ speed["linear"]
            data.qvel[6 * k + 3 : 6 * k + 6] = turn.T @ (to_floor[:3, :3] @ speed["angular"])
        centres = []
        for moment in times:
            while data.time < moment - PEER_STEP / 2:
                mujoco.mj_step(model, data)
            centres.append(data.qpos.reshape(-1, 7)[:, :3].copy())
        return (np.array(centres).transpose(1, 0, 2) - poses[..., :3, 3]).ravel()

    start = time.perf_counter()
    bounds = [np.array([[PEER_BOUNDS[name][end]] for name in names]) for end in (0, 1)]
    first = np.array([[PEER_START[name]] for name in names])
    residual = lambda x: np.stack([rollout(column) for column in np.atleast_2d(x.T)], axis=1)  # noqa: E731
    found, _ = minimize.least_squares(first, residual, bounds, eps=1e-2, verbose=minimize.Verbosity.SILENT)
    told = {name: float(value) for name, value in zip(names, np.ravel(found), strict=True)}
    if "mass_ratio" in told:
        told["mass_ratio"] = float(np.exp(told["mass_ratio"]) * masses[2] / masses[1])
    return told, time.perf_counter() - start


def film_row(kind, seed, sensor):
    """Return the figures of one film."""
    frames, camera, truth = make_sequence(np.random.default_rng([seed, KINDS.index(kind)]), kind, sensor)
    row = {"kind": kind, "seed": seed, "truth": numbers_of(truth["materials"])}
    if kind != "push":  # nobody tells the peer of the pusher
        row["peer"], row["peer_seconds"] = peer(truth) if truth["parameters"] else ({}, 0.0)
    return {**row, **infer_film(frames, camera, truth, seed)}


def numbers_of(materials):
    """Return {parameter: value} of what a film was made with; `mass_ratio` is that of box_2 to box_1."""
    found = {name: materials[name] for name in ("friction", "restitution")}
    masses = materials["masses"]
    if {"box_1", "box_2"} <= set(masses):
        found["mass_ratio"] = masses["box_2"] / masses["box_1"]
    return found


def error_of(name, value, true):
    """Return how far a number is off: relative, but of restitution."""
    return abs(value - true) / (1.0 if name == "restitution" else true)


def evaluate_dynamics(count, first, sensor, kinds, keep, verbose):
    """Make films, infer what moves how, print the table; `keep` : folder of results that are not done again, or ''."""
    folder = make_folder(keep) if keep else None
    rows = []
    for kind in names_in(kinds, KINDS, "kind of film"):
        for seed in range(first, first + count):
            path = folder and folder / f"{kind}_{seed:03d}.json"
            if path and path.exists():
                rows.append(json.loads(path.read_text()))
            else:
                rows.append(film_row(kind, seed, sensor))
                if path:
                    path.write_text(json.dumps(rows[-1]))
            if verbose:
                row = rows[-1]
                found = "; ".join(
                    f"{n} {row['truth'].get(n, float('nan')):.3f}: {m:.3f} ({a:.3f}-{b:.3f})"
                    + ("" if n in row["told"] else ", not told")
                    for n, (m, a, b) in row["intervals"].items()
                )
                print(f"{kind} {seed}: {found}; peer {row.get('peer', {})}; {row['seconds']:.1f} s", flush=True)
    print("| number | films | told | median error | within | 90 % intervals hold, told / all | peer on true poses: "
          "median error, within | goal |\n" + "|---" * 8 + "|")  # fmt: skip
    for name, limit in WITHIN.items():
        known = [row for row in rows if name in row["truth"]]
        if known:
            print_number(name, limit, known)
    seconds = [row["seconds"] for row in rows]
    print(f"\nseconds a film: median {np.median(seconds):.1f}, most {np.max(seconds):.1f} (goal: at most 60); of them "
          f"tracking {np.median([row['tracking'] for row in rows]):.1f}; goal of intervals: .85-.97")  # fmt: skip


def print_number(name, limit, rows):
    """Print the table's row of one number over films whose truth is known."""
    holds = lambda some: f"{np.mean(some):.2f}" if some else "-"  # noqa: E731

    def errors(pairs):
        off = [error_of(name, value, true) for value, true in pairs]
        return f"{np.median(off):.3f} | {np.mean(np.array(off) <= limit):.2f}" if off else "- | -"

    inside = {"told": [], "all": []}
    for row in rows:
        if name in row["intervals"]:
            _, low, high = row["intervals"][name]
            inside["all"].append(low <= row["truth"][name] <= high)
            if name in row["told"]:
                inside["told"].append(inside["all"][-1])
    told = [(row["intervals"][name][0], row["truth"][name]) for row in rows if name in row["told"]]
    theirs = [(row["peer"][name], row["truth"][name]) for row in rows if name in row.get("peer", {})]
    print(f"| {name} | {len(rows)} | {len(told)} | {errors(told)} | {holds(inside['told'])} / {holds(inside['all'])} | "
          f"{errors(theirs).replace(' |', ',')} | {GOALS[name]} |")  # fmt: skip
