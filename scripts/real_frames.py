"""Real frames for scripts/evaluate.py: masks, edges and sizes of mosd, sizes and their intervals of graspnet and ycbv.

The folder is DERENDER_REAL, else ../shared/real; its README says what is where.
"""

import json
import os
import time
from itertools import product
from pathlib import Path

import numpy as np

from derender.camera.intrinsics import Camera
from derender.evaluation.metrics import assign
from derender.report.scene_json import scene_json
from derender.structures.infer import infer_structure
from worlds.made_scenes import render_floor_scene

# The sugar box as its data set publishes it, by caliper: the extents of its scan, 45 x 92 x 176 mm, are those of the
# bulges of cardboard (of the cracker box 72 x 164 x 213 for 60 x 158 x 210). The others were measured on these frames.
GRASPNET = {"sugar": (0.038, 0.089, 0.175), "cheezit": (0.051, 0.153, 0.194), "cylinder": (0.0664, 0.0664, 0.151)}
WHOLE = 0.95  # share of an object's pixels that shows: then its measured length and width are no lower bounds
CLOSE = 0.008  # metres within which a size counts as right


def real_folder():
    """Return the folder of real frames, or None."""
    folder = Path(os.environ.get("DERENDER_REAL", Path(__file__).resolve().parents[2] / "shared" / "real"))
    return folder if folder.is_dir() else None


def read_frame(folder, stem, camera_name=None):
    """Return (depth (H, W) in metres, NaN = no return, Camera) of a frame: a 16-bit image and its camera file."""
    import imageio.v3 as imageio

    path = folder / "depth" / f"{stem}.png" if camera_name else folder / f"{stem}_depth.png"
    depth = imageio.imread(path).astype(float)
    camera = Camera.from_file(folder / (camera_name or f"{stem}_camera.json"), depth.shape)
    depth *= camera.depth_scale / 1000
    return np.where(depth > 0, depth, np.nan), camera


def predicted_labels(told, depth):
    """Return (H, W) int: 1 + the solid that each pixel with a return shows within 3 cm, 0 for none, and their names.

    told : Explanation.
    """
    shown = (told.label >= 0) & (np.abs(np.nan_to_num(depth) - told.depth) < 0.03)
    return np.where(shown, told.label + 1, 0), told.names


def evaluate_mosd(folder, options, seeds, verbose):
    """Return the table row of the 45 Kinect frames (F1 of masks and of support edges) and a text on the sizes.

    seeds : each frame is inferred with so many; a frame's few edges are .06 of all, and another seed may lose them.
    """
    import imageio.v3 as imageio

    folder = folder / "mosd"
    graphs = json.loads((folder / "support_graph.json").read_text())
    measured = json.loads((folder / "reference_measurements.json").read_text())
    hits = said = true = 0
    edges = np.zeros(3)
    seconds, sizes = [], []
    for path, seed in product(sorted((folder / "depth").glob("*.png")), range(seeds)):
        depth, camera = read_frame(folder, path.stem, "camera.json")
        start = time.perf_counter()
        posterior = infer_structure(depth, camera, options, np.random.default_rng(seed))
        graph = posterior.best_graph()
        seconds.append(time.perf_counter() - start)
        label = imageio.imread(folder / "label" / path.name) // 10
        predicted, names = predicted_labels(posterior.explanation, depth)
        ids = [k for k in np.unique(label) if k >= 2]
        overlap = np.array([[np.sum((predicted == j + 1) & (label == k)) / np.sum((predicted == j + 1) | (label == k))
                             for k in ids] for j in range(len(names))]).reshape(len(names), len(ids))  # fmt: skip
        hits, said, true = hits + len(assign(overlap, 0.5)), said + len(names), true + len(ids)
        who = {names[j]: ids[k] for j, k in assign(overlap, 0.25)}
        if path.stem in graphs:
            called = {name: str(number) for name, number in who.items()} | {"floor": "table"}
            told = {(called.get(n, "?"), called.get(graph.vertex(n).parent, "?")) for n in names}
            known = {(child, str(parent)) for child, parent in graphs[path.stem].items()}
            edges += len(told & known), len(told), len(known)
        truth = {each["label10"]: each for each in measured[path.stem]["objects"]}
        solids = {item["name"]: item for item in scene_json(graph)["objects"]}
        found = [size_errors(solids[name], solids["floor"], truth[number], np.sum(label == number), camera)
                 for name, number in who.items()]  # fmt: skip
        sizes += found
        if verbose:
            print(path.stem, seed, "masks", len(assign(overlap, 0.5)), "of", len(ids), "found", len(names))
            for (name, number), error in zip(who.items(), found, strict=True):
                print(f"  {name} ({number}): off by", {key: round(1000 * value) for key, value in error.items()}, "mm")
    row = {"set": "mosd", "scenes": len(seconds), "F1 @ 0.5": 2 * hits / (said + true),
           "graph exact": 2 * edges[0] / (edges[1] + edges[2]), "seconds": np.median(seconds)}  # fmt: skip
    return row, size_table(sizes)


def size_errors(solid, floor, truth, pixels, camera):
    """Return how far a solid's top, width and length are off what was measured, in metres, by name.

    What was measured of a partly hidden object is a lower bound: there only what falls short of it is off.

    solid, floor : items of the JSON form. pixels : of the object in the image, where it is not hidden.
    truth : of reference_measurements.json: height of the top over the table, visible length L and width W.
    """
    floor_pose, pose, size = np.array(floor["pose"]), np.array(solid["pose"]), np.array(solid["size"])
    drawn = "box" if solid["type"] == "thing" else solid["type"]
    _, label = render_floor_scene([drawn], pose[None], size[None], floor_pose, camera)
    partly = pixels < WHOLE * np.sum(label == 0)
    pose = np.linalg.inv(floor_pose) @ pose
    up = np.abs(pose[2, :3])
    reach = up @ size
    if solid["type"] == "cylinder":
        reach = np.hypot(up[0], up[1]) * size[0] + up[2] * size[2]
    elif solid["type"] == "sphere":
        reach = size[0]
    plan = np.sort(np.delete(size, np.argmax(up)))  # the edges across the one nearest the vertical
    errors = {"top": pose[2, 3] + 0.5 * reach - truth["top"]}
    for key, extent, seen in (("width", plan[0], truth["W"]), ("length", plan[1], truth["L"])):
        errors[key] = min(extent - seen, 0.0) if partly else extent - seen
    return errors


def size_table(errors):
    """Return a text: the median and the ninth decile of the errors' amounts, and how many are at most CLOSE."""
    lines = [f"sizes of {len(errors)} objects (of partly hidden ones only what falls short of what shows):"]
    for key in errors[0]:
        off = np.array([each[key] for each in errors])
        middle, most = (1000 * np.quantile(np.abs(off), q) for q in (0.5, 0.9))
        close = np.mean(np.abs(off) <= CLOSE)
        lines.append(f"  {key:6s} off by {middle:.1f} mm at the median, {most:.1f} in nine of ten, on average "
                     f"{1000 * off.mean():+.1f}; {close:.0%} within {1000 * CLOSE:.0f}")  # fmt: skip
    return "\n".join(lines)


def report_sizes(folder, options):
    """Print the sizes found on the graspnet and ycbv frames, with their 90 % intervals and the true ones."""
    frames = [("graspnet", name) for name in GRASPNET] + [("ycbv", "0001_000001")]
    for kind, name in frames:
        depth, camera = read_frame(folder / kind, name)
        start = time.perf_counter()
        posterior = infer_structure(depth, camera, options, np.random.default_rng(0))
        seconds = time.perf_counter() - start
        print(f"\n{kind} {name}: {seconds:.2f} s")
        items = [item for item in scene_json(posterior.best_graph())["objects"] if item["size"] is not None]
        truths = [(np.sort(GRASPNET[name]), "")] if kind == "graspnet" else ycbv_truths(folder / kind, name, items)
        for item, (truth, note) in zip(items, truths, strict=False):
            size = np.array(item["size"])
            draws = sizes_drawn(posterior, item["name"], size)
            low, high = (1000 * q for q in np.quantile(draws, (0.05, 0.95), axis=0))
            order = np.argsort(size)
            said = ", ".join(f"{1000 * size[k]:.0f} ({low[k]:.0f} to {high[k]:.0f})" for k in order)
            print(f"  {item['type']:9s}{said} mm on {item['parent']}; true {np.round(1000 * truth)}{note}")


def sizes_drawn(posterior, name, size):
    """Return the sizes (n, 3) of a solid in the draws of the best structure."""
    part = posterior.best_part
    values = part.values.reshape(-1, len(part.addresses))
    at = {address.partition(".")[2]: values[:, k] for k, address in enumerate(part.addresses)
          if address.startswith(name + ".")}  # fmt: skip
    if "side" in at:
        return np.column_stack([at["side"]] * 3)
    if "length" in at:
        return np.column_stack([at["length"], at["width"], at["height"]])
    across = 2.0 * at["radius"]
    return np.column_stack([across, across, at.get("height", across)])


def ycbv_truths(folder, frame, items):
    """Return for each solid the nearest model's (extents, in order, of the box about its hull; a note on its height).

    The poses of this data set put the models some millimetres into the table that the image shows.
    """
    import trimesh

    extents, centres, notes = [], [], []
    for each in json.loads((folder / f"{frame}_gt.json").read_text())["objects"]:
        mesh = trimesh.load(folder / "meshes" / f"{each['name']}.obj")
        _, box = trimesh.bounds.oriented_bounds(mesh)
        pose = np.array(each["pose_obj_to_cam_3x4"])
        extents.append(np.sort(box))
        notes.append(f", its top {1000 * each['z_above_table'][1]:.0f} over the table in the image")
        centres.append(pose[:, :3] @ mesh.centroid + pose[:, 3])
    nearest = [np.argmin(np.linalg.norm(np.array(centres) - np.array(i["pose"])[:3, 3], axis=1)) for i in items]
    return [(extents[k], notes[k]) for k in nearest]
