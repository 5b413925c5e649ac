"""Objects found on hand-labelled real frames, as they are and as variants that must not change what is there.

    python scripts/evaluate.py frames                                            every frame, every variant
    python scripts/evaluate.py frames --only ycbv_0,tum_desk_1 --kinds plain,mirrored
    python scripts/evaluate.py frames --keep OUT --verbose                       with a picture and a line for each

A variant shows the same scene: mirrored left-right, searched with another seed, without a twentieth of the image on
each side, with every second row and column, with NOISE of the depth squared added, or without LOST of the returns.
Labels go with the image. Told of each variant: recall of what a person tells from depth, the same with difficult
objects, precision, solids on what is labelled background, frames in which nothing was found though something is there,
and `changed`, the share of labelled objects that are found in the variant but not in the frame as it is, or the other
way round. Matching is that of score.py beside the labels: the object shows at the labelled pixel within NEAR of its
depth and its image box overlaps the labelled one by IOU or more.
"""

import json
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from real_frames import real_folder

from derender.camera.intrinsics import Camera
from derender.structures.infer import infer_structure
from derender.structures.options import Options

NEAR, IOU = 0.03, 0.5  # metres; of image boxes
CROPPED = 0.05  # of the image on each side
CUT = 0.1  # of a labelled box's sides that a crop may take before the object counts as difficult
NOISE = 0.001  # metres at one metre, growing with the depth squared: half of what consumer sensors have
LOST = 0.1  # share of the returns that are dropped
STREAM = 12  # seed of that noise and those losses


class Frame(NamedTuple):
    """A depth image (H, W) in metres, NaN = no return, its camera, what labels.json says of it, and a seed."""

    depth: np.ndarray
    camera: Camera
    label: dict
    seed: int = 1


class Score(NamedTuple):
    """Of one frame: labelled objects by number that were found; and counts.

    `easy` and `every`: labelled objects, without and with difficult ones; solids : found in all, where all are
    labelled; behind : solids that show where background is labelled; empty : nothing found though something is there.
    """

    found: list[int]
    easy: list[int]
    every: int
    solids: int
    complete: bool
    behind: int
    empty: bool
    seconds: float
    no_floor: bool


def read_frame(folder, name, label):
    """Return the Frame of this name."""
    import imageio.v3 as imageio

    path = folder / f"{name}.npy"
    depth = np.load(path).astype(float) if path.exists() else imageio.imread(folder / f"{name}.png") / 1000.0
    camera = Camera.from_file(folder / f"{name}_camera.json", depth.shape)
    return Frame(np.where(depth > 0, depth, np.nan), camera, label)


def seen_through(frame, rows, columns, camera):
    """Return the Frame of chosen rows and columns, ints in the order in which they are taken, with the labels moved."""

    def moved(numbers, chosen):
        """Return where rows or columns lie among those chosen, and how far outside they are."""
        order = np.argsort(chosen)
        place = np.interp(numbers, chosen[order], order.astype(float))
        return np.rint(place).astype(int), np.abs(np.asarray(numbers) - np.clip(numbers, chosen.min(), chosen.max()))

    objects = []
    kept = {}
    for number, item in enumerate(frame.label["objects"]):
        (x,), out_x = moved([item["pixel"][0]], columns)
        (y,), out_y = moved([item["pixel"][1]], rows)
        xs, over_x = moved([item["box"][0], item["box"][2]], columns)
        ys, over_y = moved([item["box"][1], item["box"][3]], rows)
        if max(out_x[0], out_y[0]) > 1:
            continue
        wide, high = item["box"][2] - item["box"][0] + 1, item["box"][3] - item["box"][1] + 1
        cut = over_x.sum() > CUT * wide or over_y.sum() > CUT * high
        kept[number] = len(objects)
        box = [int(min(xs)), int(min(ys)), int(max(xs)), int(max(ys))]
        objects.append({**item, "pixel": [int(x), int(y)], "box": box, "number": number,
                        "difficult": bool(item.get("difficult") or cut)})  # fmt: skip
    behind = []
    for x, y in frame.label["background"]:
        (c,), out_c = moved([x], columns)
        (r,), out_r = moved([y], rows)
        if max(out_c[0], out_r[0]) <= 1:
            behind.append([int(c), int(r)])
    label = {**frame.label, "objects": objects, "background": behind}
    return Frame(np.ascontiguousarray(frame.depth[np.ix_(rows, columns)]), camera, label, frame.seed)


def whole(frame):
    """Return all rows and columns of a Frame."""
    return np.arange(frame.depth.shape[0]), np.arange(frame.depth.shape[1])


def with_camera(camera, columns, rows, **changed):
    """Return a Camera for so many columns and rows with some numbers changed."""
    numbers = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, **changed}
    return Camera(**numbers, width=columns, height=rows)


def plain(rng, frame):
    """Return the frame as it is, its objects numbered."""
    return seen_through(frame, *whole(frame), frame.camera)


def mirrored(rng, frame):
    rows, columns = whole(frame)
    camera = with_camera(frame.camera, len(columns), len(rows), cx=len(columns) - 1 - frame.camera.cx)
    return seen_through(frame, rows, columns[::-1], camera)


def another_seed(rng, frame):
    return plain(rng, frame)._replace(seed=2)


def cropped(rng, frame):
    rows, columns = (each[round(CROPPED * len(each)) : len(each) - round(CROPPED * len(each))] for each in whole(frame))
    camera = with_camera(frame.camera, len(columns), len(rows), cx=frame.camera.cx - columns[0],
                         cy=frame.camera.cy - rows[0])  # fmt: skip
    return seen_through(frame, rows, columns, camera)


def halved(rng, frame):
    rows, columns = (each[::2] for each in whole(frame))
    half = {key: 0.5 * getattr(frame.camera, key) for key in ("fx", "fy", "cx", "cy")}
    return seen_through(frame, rows, columns, with_camera(frame.camera, len(columns), len(rows), **half))


def noisier(rng, frame):
    noise = NOISE * np.nan_to_num(frame.depth) ** 2 * rng.standard_normal(frame.depth.shape)
    return plain(rng, frame._replace(depth=frame.depth + noise))


def sparser(rng, frame):
    return plain(rng, frame._replace(depth=np.where(rng.random(frame.depth.shape) < LOST, np.nan, frame.depth)))


VARIANTS = {
    "plain": plain,
    "mirrored": mirrored,
    "seed": another_seed,
    "cropped": cropped,
    "halved": halved,
    "noisier": noisier,
    "sparser": sparser,
}


def overlap(one, other):
    """Return the intersection over union of two boxes (c0, r0, c1, r1), ends included."""
    wide = min(one[2], other[2]) - max(one[0], other[0]) + 1
    high = min(one[3], other[3]) - max(one[1], other[1]) + 1
    both = max(wide, 0) * max(high, 0)
    areas = [(box[2] - box[0] + 1) * (box[3] - box[1] + 1) for box in (one, other)]
    return both / (sum(areas) - both)


def box_of(mask):
    """Return the box (c0, r0, c1, r1) of the pixels of a mask, None where there are none."""
    rows, columns = np.nonzero(mask)
    return (columns.min(), rows.min(), columns.max(), rows.max()) if len(rows) else None


def score(frame, posterior, seconds):
    """Return the Score of what was found in a Frame."""
    told, objects = posterior.explanation, frame.label["objects"]
    boxes = [box_of(told.label == k) for k in range(len(told.names))]

    def shown(x, y):
        """Return which solid shows at a pixel, within NEAR of its depth; negative: none."""
        return int(told.label[y, x]) if abs(told.depth[y, x] - frame.depth[y, x]) < NEAR else -1

    pairs = []
    for j, item in enumerate(objects):
        k = shown(*item["pixel"])
        if k >= 0 and boxes[k] is not None and (share := overlap(boxes[k], item["box"])) >= IOU:
            pairs.append((share, j, k))
    at: dict[int, int] = {}
    for _, j, k in sorted(pairs, reverse=True):
        if j not in at and k not in at.values():
            at[j] = k
    easy = [item["number"] for item in objects if not item["difficult"]]
    behind = {k for x, y in frame.label["background"] if (k := shown(x, y)) >= 0 and k not in at.values()}
    found = sorted(objects[j]["number"] for j in at)
    empty = bool(easy) and not told.names
    return Score(found, easy, len(objects), len(told.names), frame.label["complete"], len(behind), empty, seconds,
                 bool(posterior.meta.get("no_floor")))  # fmt: skip


def draw_picture(path, frame, posterior):
    """Write a picture: depth in grey, a colour for each solid, labelled boxes white, difficult ones grey."""
    import imageio.v3 as imageio
    from matplotlib import colormaps

    depth, told = frame.depth, posterior.explanation
    low, high = np.nanquantile(depth, [0.01, 0.97])
    grey = np.nan_to_num(1.0 - 0.7 * np.clip((depth - low) / (high - low), 0, 1))
    picture = np.repeat(grey[..., None], 3, axis=2)
    colours = colormaps["tab10"].colors
    for k in range(len(told.names)):
        mask = told.label == k
        picture[mask] = 0.4 * picture[mask] + 0.6 * np.array(colours[k % 10])
    missed = told.label == -3  # unexplained
    picture[missed] = 0.5 * picture[missed] + [0.5, 0.0, 0.5]
    beside = np.repeat(grey[..., None], 3, axis=2)
    for item in frame.label["objects"]:
        c0, r0, c1, r1 = np.clip(item["box"], 0, [depth.shape[1] - 1, depth.shape[0] - 1] * 2)
        bright = 0.6 if item["difficult"] else 1.0
        for image in (picture, beside):
            image[[r0, r1], c0 : c1 + 1] = image[r0 : r1 + 1, [c0, c1]] = bright
    imageio.imwrite(path, (255 * np.clip(np.hstack([beside, picture]), 0, 1)).astype(np.uint8))


def share_of(part, whole):
    """Return a share in three digits; nothing where there is no whole."""
    return f"{part / whole:.3f}" if whole else ""


def evaluate_frames(only="", kinds="", keep="", method="auto", verbose=False):
    """Print a row for each variant of the labelled frames.

    only : names of frames, and kinds : of variants, with commas between; none: all. keep : folder of the pictures and
    scores, from which what is there is taken. method : see Options.
    """
    folder = real_folder()
    if folder is None or not (folder / "frames" / "labels.json").exists():
        print("no labelled real frames here")
        return
    folder /= "frames"
    labels = json.loads((folder / "labels.json").read_text())
    names = [name for name in only.split(",") if name] or list(labels)
    chosen = [kind for kind in kinds.split(",") if kind] or list(VARIANTS)
    scores: dict[str, dict[str, Score]] = {kind: {} for kind in chosen}
    for name in names:
        frame = read_frame(folder, name, labels[name])
        for kind in chosen:
            kept = Path(keep) / f"{name}.{kind}.json" if keep else None
            if kept is not None and kept.exists():
                row = Score(**json.loads(kept.read_text()))
            else:
                made = VARIANTS[kind](np.random.default_rng(STREAM), frame)
                began = time.perf_counter()
                posterior = infer_structure(made.depth, made.camera, Options(method=method, seed=made.seed))
                row = score(made, posterior, time.perf_counter() - began)
                if kept is not None:
                    kept.parent.mkdir(parents=True, exist_ok=True)
                    draw_picture(kept.with_suffix(".png"), made, posterior)
                    kept.write_text(json.dumps(row._asdict()))
            scores[kind][name] = row
            if verbose:
                missed = [k for k in row.easy if k not in row.found]
                print(f"{name} {kind}: found {row.found}, missed {missed}, solids {row.solids}, behind {row.behind}"
                      f"{', no floor' if row.no_floor else ''}, {row.seconds:.1f} s", flush=True)  # fmt: skip
    print("| variant | recall | with difficult | precision | background | nothing | changed | median, worst s |")
    print("|---" * 8 + "|")
    for kind, rows in scores.items():
        every = list(rows.values())
        hits, easy = sum(len({*r.found} & {*r.easy}) for r in every), sum(len(r.easy) for r in every)
        full = [r for r in every if r.complete]
        changed = total = 0
        for name, row in rows.items():
            first = scores["plain"].get(name) if "plain" in scores else None
            if first is not None:
                both = {*first.easy} & {*row.easy}
                changed += len(({*first.found} ^ {*row.found}) & both)
                total += len(both)
        seconds = [r.seconds for r in every]
        cells = [share_of(hits, easy), share_of(sum(len(r.found) for r in every), sum(r.every for r in every)),
                 share_of(sum(len(r.found) for r in full), sum(r.solids for r in full)),
                 sum(r.behind for r in every), sum(r.empty for r in every), share_of(changed, total),
                 f"{np.median(seconds):.1f}, {max(seconds):.1f}"]  # fmt: skip
        print(f"| {kind} | {' | '.join(map(str, cells))} |", flush=True)
