"""Objects found on hand-labelled real frames, as they are and as variants that must not change what is there.

    python scripts/evaluate.py frames                                            every frame, every variant
    python scripts/evaluate.py frames --only ycbv_0,tum_desk_1 --kinds plain,mirrored
    python scripts/evaluate.py frames --keep OUT --verbose                       with a picture and a line for each

A variant shows the same scene as another camera might: mirrored, searched with another seed, cropped, its upper, lower,
left or right PART, halved in resolution, turned by quarter turns, rolled, pitched up or down, yawed, through a longer
or shorter lens, with more noise, without LOST of the returns or those beside steps in depth (frayed), off by a slow
bias, rounded to millimetres or to disparities, half or thrice as far away and large (nearer, farther). Labels are
looked up where their pixels went. Told of each variant: recall of what a person tells from depth, the same with
difficult objects, precision, solids on what is labelled background, frames in which nothing was found though something
is there, how often a plane passes within SUPPORT of the pixel labelled as the support's, `changed`, the share of
labelled objects that are found in the variant but not in the frame as it is, or the other way round, how many answers
are trusted, and of their solids, and of all that are trusted by themselves, the share that is there. In the end how
often solids are there that are said to be with a probability. Matching is that of score.py beside the labels: the
object shows at the labelled pixel within NEAR of its depth and its image box overlaps the labelled one by IOU or more.

    python scripts/evaluate.py floors --kinds plain,upper,"turned twice"         whether the support is found, 2 s a row
"""

import json
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from arguments import names_in
from real_frames import real_folder

from derender.camera.intrinsics import Camera
from derender.detection.search.observation import observe
from derender.errors import DerenderError
from derender.report.contents import report_of
from derender.results.trust import trusted
from derender.structures.infer import infer_structure
from derender.structures.options import Options

NEAR, IOU = 0.03, 0.5  # metres; of image boxes
CROPPED = 0.05  # of the image on each side
CUT = 0.1  # of a labelled box's sides that a crop may take before the object counts as difficult
NOISE = 0.001  # metres at one metre, growing with the depth squared: half of what consumer sensors have
LOST = 0.1  # share of the returns that are dropped
TURN = np.radians(12.0)  # by which a camera is turned about one of its axes
FILLS = 0.95  # of a row or a column at the border of a view that is turned
LENS = 1.25  # times as long a focal length, the same pixels: a scene that is as much narrower
PART = 0.6  # of the rows or columns that a view has that shows a part of the scene
SUPPORT = 0.02  # metres within which a plane passes the labelled pixel of the support
SOME = 0.03  # share of a view's pixels that show the support: of fewer it need not be found
STEP = 0.02  # share of the depth between neighbouring pixels of two surfaces
FRAYED = 3  # pixels beside a step in depth that return nothing
BIAS = 0.01  # share of the depth by which it is off at most
ROUNDED = 0.005  # metres
DISPARITY = 0.0029  # of inverse depth, 1/m: an eighth of a pixel of Kinect v1 (580 pixels by 75 mm)
STREAM = 12  # seed of that noise and those losses


class Frame(NamedTuple):
    """A depth image (H, W) in metres, NaN = no return, its camera, and what labels.json says of it.

    source : (H, W, 2) int, row and column of each pixel in the frame as it is. seed : of inference. scale : times as
    long are its lengths.
    """

    depth: np.ndarray
    camera: Camera
    label: dict
    source: np.ndarray
    seed: int = 1
    scale: float = 1.0


class Score(NamedTuple):
    """Of one frame: labelled objects by number that were found; and counts.

    `easy` and `every`: labelled objects, without and with difficult ones; solids : found in all, where all are
    labelled; behind : solids that show where background is labelled; empty : nothing found though something is there;
    support : whether a plane passes through the pixel labelled as the support's, None where none is. trusted : the
    answer; told : of each solid the probability that it is there, whether it is trusted, and whether it is there.
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
    support: bool | None
    trusted: bool = False
    told: list[tuple[float, bool, bool]] = []


def read_frame(folder, name, label):
    """Return the Frame of this name."""
    import imageio.v3 as imageio

    path = folder / f"{name}.npy"
    depth = np.load(path).astype(float) if path.exists() else imageio.imread(folder / f"{name}.png") / 1000.0
    camera = Camera.from_file(folder / f"{name}_camera.json", depth.shape)
    source = np.stack(np.indices(depth.shape), axis=-1)
    return Frame(np.where(depth > 0, depth, np.nan), camera, label, source)


def seen_through(frame, rows, columns, camera):
    """Return the Frame that a camera sees whose pixels lie at rows and columns (H', W') of the frame as it is.

    Between pixels of one surface the depth is interpolated (its inverse is affine on a plane), else it is the nearest.
    """
    y, x = np.rint(rows).astype(int), np.rint(columns).astype(int)
    depth = frame.depth[y, x]
    if (y != rows).any() or (x != columns).any():
        from scipy.ndimage import map_coordinates

        between = 1.0 / map_coordinates(1.0 / frame.depth, [rows, columns], order=1)
        depth = np.where(np.abs(between - depth) < STEP * depth, between, depth)
    return frame._replace(depth=np.ascontiguousarray(depth), camera=camera, source=np.stack([y, x], axis=-1))


def with_camera(camera, shape, **changed):
    """Return a Camera of an image of this shape with some numbers changed."""
    numbers = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy, **changed}
    return Camera(**numbers, width=shape[1], height=shape[0])


def mirrored(rng, frame):
    rows, columns = np.indices(frame.depth.shape)
    camera = with_camera(frame.camera, rows.shape, cx=rows.shape[1] - 1 - frame.camera.cx)
    return seen_through(frame, rows, columns[:, ::-1], camera)


def part_of(frame, top, bottom, left, right):
    """Return the Frame between shares of the rows and of the columns."""
    height, width = frame.depth.shape
    rows, columns = np.indices(frame.depth.shape)[:, round(top * height) : round(bottom * height),
                                                  round(left * width) : round(right * width)]  # fmt: skip
    place = {"cx": frame.camera.cx - columns[0, 0], "cy": frame.camera.cy - rows[0, 0]}
    return seen_through(frame, rows, columns, with_camera(frame.camera, rows.shape, **place))


def halved(rng, frame):
    rows, columns = np.indices(frame.depth.shape)[:, ::2, ::2]
    half = {key: 0.5 * getattr(frame.camera, key) for key in ("fx", "fy", "cx", "cy")}
    return seen_through(frame, rows, columns, with_camera(frame.camera, rows.shape, **half))


def turned(frame, times):
    """Return the Frame turned by quarter turns."""
    rows, columns = (np.rot90(index, times) for index in np.indices(frame.depth.shape))
    camera = frame.camera
    for k in range(times):
        width = frame.depth.shape[(k + 1) % 2]
        numbers = {"fx": camera.fy, "fy": camera.fx, "cx": camera.cy, "cy": width - 1 - camera.cx}
        camera = with_camera(camera, frame.depth.shape[::-1] if k % 2 == 0 else frame.depth.shape, **numbers)
    return seen_through(frame, rows, columns, camera)


def through_lens(frame, times):
    """Return the Frame of a scene that is narrower and lower before a camera of a focal length as much longer."""
    longer = {"fx": times * frame.camera.fx, "fy": times * frame.camera.fy}
    return frame._replace(camera=with_camera(frame.camera, frame.depth.shape, **longer))


def rotated(frame, *angles):
    """Return the Frame of a camera turned about its centre, by angles (radians) about its axes x, y and z.

    That shows nothing that was hidden. The view ends with the rows and columns that the frame FILLS.
    """
    from scipy.spatial.transform import Rotation

    camera, (height, width) = frame.camera, frame.depth.shape
    x, y, z = np.moveaxis(camera.rays() @ Rotation.from_euler("xyz", angles).as_matrix().T, -1, 0)  # the frame's axes
    rows, columns = camera.cy + camera.fy * y / z, camera.cx + camera.fx * x / z
    inside = (rows >= 0) & (rows <= height - 1) & (columns >= 0) & (columns <= width - 1)
    ends = np.array([0, height - 1, 0, width - 1])
    while True:
        top, bottom, left, right = ends
        window = np.s_[top : bottom + 1, left : right + 1]
        part = inside[window]
        filled = [line.mean() for line in (part[0], part[-1], part[:, 0], part[:, -1])]
        if min(filled) >= FILLS:
            break
        ends[np.argmin(filled)] += (1, -1, 1, -1)[np.argmin(filled)]
    place = np.clip(rows, 0, height - 1)[window], np.clip(columns, 0, width - 1)[window]
    seen = seen_through(frame, *place, with_camera(camera, part.shape, cx=camera.cx - left, cy=camera.cy - top))
    return seen._replace(depth=np.where(part, seen.depth / z[window], np.nan))


def noisier(rng, frame):
    noise = NOISE * np.nan_to_num(frame.depth) ** 2 * rng.standard_normal(frame.depth.shape)
    return frame._replace(depth=frame.depth + noise)


def frayed(rng, frame):
    """Without the returns within FRAYED pixels of a step in depth."""
    from scipy.ndimage import maximum_filter, minimum_filter

    low = minimum_filter(np.nan_to_num(frame.depth, nan=np.inf), 3)
    high = maximum_filter(np.nan_to_num(frame.depth, nan=0.0), 3)
    edge = maximum_filter(high - low > STEP * frame.depth, 2 * FRAYED - 1)
    return frame._replace(depth=np.where(edge, np.nan, frame.depth))


def biased(rng, frame):
    """Depths off by a share of up to BIAS that changes slowly over the image."""
    y, x = (np.linspace(-1.0, 1.0, count) for count in frame.depth.shape)
    return frame._replace(depth=frame.depth * (1.0 + BIAS * np.outer(np.cos(2.0 * y), np.sin(2.0 * x))))


VARIANTS = {
    "plain": lambda rng, frame: frame,
    "seed": lambda rng, frame: frame._replace(seed=2),
    "mirrored": mirrored,
    "cropped": lambda rng, frame: part_of(frame, CROPPED, 1.0 - CROPPED, CROPPED, 1.0 - CROPPED),
    "upper": lambda rng, frame: part_of(frame, 0.0, PART, 0.0, 1.0),
    "lower": lambda rng, frame: part_of(frame, 1.0 - PART, 1.0, 0.0, 1.0),
    "left": lambda rng, frame: part_of(frame, 0.0, 1.0, 0.0, PART),
    "right": lambda rng, frame: part_of(frame, 0.0, 1.0, 1.0 - PART, 1.0),
    "halved": halved,
    "turned": lambda rng, frame: turned(frame, 1),
    "turned twice": lambda rng, frame: turned(frame, 2),
    "turned thrice": lambda rng, frame: turned(frame, 3),
    "rolled": lambda rng, frame: rotated(frame, 0.0, 0.0, TURN),
    "pitched down": lambda rng, frame: rotated(frame, -TURN, 0.0, 0.0),
    "pitched up": lambda rng, frame: rotated(frame, TURN, 0.0, 0.0),
    "yawed": lambda rng, frame: rotated(frame, 0.0, TURN, 0.0),
    "longer lens": lambda rng, frame: through_lens(frame, LENS),
    "shorter lens": lambda rng, frame: through_lens(frame, 1.0 / LENS),
    "noisier": noisier,
    "sparser": lambda rng, f: f._replace(depth=np.where(rng.random(f.depth.shape) < LOST, np.nan, f.depth)),
    "frayed": frayed,
    "biased": biased,
    "rounded": lambda rng, frame: frame._replace(depth=ROUNDED * np.rint(frame.depth / ROUNDED)),
    "disparity": lambda rng, frame: frame._replace(depth=1.0 / (DISPARITY * np.rint(1.0 / frame.depth / DISPARITY))),
    "nearer": lambda rng, frame: frame._replace(depth=0.5 * frame.depth, scale=0.5),
    "farther": lambda rng, frame: frame._replace(depth=3.0 * frame.depth, scale=3.0),
}


def overlap(one, other):
    """Return the intersection over union of two boxes (c0, r0, c1, r1), ends included."""
    wide = min(one[2], other[2]) - max(one[0], other[0]) + 1
    high = min(one[3], other[3]) - max(one[1], other[1]) + 1
    both = max(wide, 0) * max(high, 0)
    areas = [(box[2] - box[0] + 1) * (box[3] - box[1] + 1) for box in (one, other)]
    return both / (sum(areas) - both)


def box_of(pixels):
    """Return the box (c0, r0, c1, r1) of pixels (N, 2), rows and columns; None where there are none."""
    return (*pixels.min(axis=0)[::-1], *pixels.max(axis=0)[::-1]) if len(pixels) else None


def pixel_in(frame, place):
    """Return the row and column at which a Frame shows a pixel (column, row) of the frame as it is; None: nowhere."""
    apart = np.abs(frame.source.reshape(-1, 2) - np.asarray(place)[::-1]).max(axis=1)
    nearest = int(np.argmin(apart))
    return np.unravel_index(nearest, frame.depth.shape) if apart[nearest] <= 1 else None


def support_met(frame, normals, offsets):
    """Return whether one of the planes normal . p = offset passes through the pixel labelled as the support's.

    None where the Frame has no such pixel. normals : (N, 3), offsets : (N,), in camera axes.
    """
    label = frame.label["support"]
    if label is None or (pixel := pixel_in(frame, label)) is None or not np.isfinite(frame.depth[pixel]):
        return None
    camera, z = frame.camera, frame.depth[pixel]
    point = z * np.array([(pixel[1] - camera.cx) / camera.fx, (pixel[0] - camera.cy) / camera.fy, 1.0])
    return bool((np.abs(np.asarray(normals) @ point - offsets) < SUPPORT * frame.scale).any())


def in_variant(frame):
    """Return (labelled objects, background pixels) of a Frame as far as they are seen in it.

    An object has its number in labels.json, its pixel in the variant, and its box as far as the variant shows it, in
    pixels of the frame as it is; cut by the variant's border it counts as difficult.
    """
    source, objects = frame.source.reshape(-1, 2), []

    for number, item in enumerate(frame.label["objects"]):
        box = np.array(item["box"])
        inside = source[((source >= box[1::-1]) & (source <= box[:1:-1])).all(axis=1)]
        if (pixel := pixel_in(frame, item["pixel"])) is None or len(inside) == 0:
            continue
        seen = np.array([*inside.min(axis=0)[::-1], *inside.max(axis=0)[::-1]])
        lost = np.abs(seen - box).reshape(2, 2) - 1  # of a halved image the last row may be left out
        cut = (lost.sum(axis=0) > CUT * (box[2:] - box[:2] + 1)).any()
        objects.append({"number": number, "pixel": pixel, "box": seen, "difficult": bool(item.get("difficult") or cut)})
    behind = [pixel for place in frame.label["background"] if (pixel := pixel_in(frame, place)) is not None]
    return objects, behind


def score(frame, posterior, seconds):
    """Return the Score of what was found in a Frame."""
    told = posterior.explanation
    objects, background = in_variant(frame)
    boxes = [box_of(frame.source[told.label == k]) for k in range(len(told.names))]

    def shown(pixel):
        """Return which solid shows at a pixel, within NEAR of its depth; negative: none."""
        return int(told.label[pixel]) if abs(told.depth[pixel] - frame.depth[pixel]) < NEAR * frame.scale else -1

    pairs = []
    for j, item in enumerate(objects):
        k = shown(item["pixel"])
        if k >= 0 and boxes[k] is not None and (share := overlap(boxes[k], item["box"])) >= IOU:
            pairs.append((share, j, k))
    at: dict[int, int] = {}
    for _, j, k in sorted(pairs, reverse=True):
        if j not in at and k not in at.values():
            at[j] = k
    easy = [item["number"] for item in objects if not item["difficult"]]
    behind = {k for pixel in background if (k := shown(pixel)) >= 0 and k not in at.values()}
    found = sorted(objects[j]["number"] for j in at)
    empty = bool(easy) and not told.names
    graph = posterior.best_graph()
    planes = [graph.poses()[vertex.name] for vertex in graph.vertices if vertex.body.size() is None]
    normals = np.array([pose[:3, 2] for pose in planes]).reshape(-1, 3)
    offsets = np.array([pose[:3, 2] @ pose[:3, 3] for pose in planes])
    likelihood = {key: value for key, value in posterior.meta["likelihood"].items() if key != "type"}
    report = report_of(graph, frame.camera, frame.depth, posterior, likelihood=likelihood, shown=False)
    solids = [item for item in report.scene["objects"] if item["size"] is not None]
    each = [(item["probability"], item["trusted"], told.names.index(item["name"]) in at.values()) for item in solids]
    return Score(found, easy, len(objects), len(told.names), frame.label["complete"], len(behind), empty, seconds,
                 bool(posterior.meta.get("no_floor")), support_met(frame, normals, offsets), trusted(report.doubts),
                 each)  # fmt: skip


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
    for item in in_variant(frame)[0]:
        low, high = item["box"][1::-1], item["box"][:1:-1]
        inside = ((frame.source >= low) & (frame.source <= high)).all(axis=2)
        outline = inside & ~((frame.source > low + 1) & (frame.source < high - 1)).all(axis=2)
        for image in (picture, beside):
            image[outline] = 0.6 if item["difficult"] else 1.0
    imageio.imwrite(path, (255 * np.clip(np.hstack([beside, picture]), 0, 1)).astype(np.uint8))


def of_all(answers):
    """Return how many of those that say something (bool, or None) are true: "17 of 18"."""
    said = [answer for answer in answers if answer is not None]
    return f"{sum(said)} of {len(said)}"


def error_of(told):
    """Return the expected calibration error of probabilities, in ten bins; told : [(probability, _, it is so)]."""
    said, there = np.array([(probability, right) for probability, _, right in told]).T
    bins = np.minimum((10 * said).astype(int), 9)
    return sum(abs((said - there)[bins == k].sum()) for k in range(10)) / len(said)


def counts(told):
    """Return how many of some solids are there, and of how many."""
    return sum(each[2] for each in told), len(told)


def share_of(part, whole):
    """Return a share in three digits; nothing where there is no whole."""
    return f"{part / whole:.3f}" if whole else ""


def points_of(frame):
    """Return (H, W, 3) the points of a Frame in camera axes."""
    row, column = np.indices(frame.depth.shape)
    camera = frame.camera
    rays = np.stack([(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(row.shape)], axis=-1)
    return rays * frame.depth[..., None]


def first_floor(frame):
    """Return (the Observation of a Frame, the normal (3,) and the offset of the floor that it starts from)."""
    seen = observe(frame.depth, frame.camera)
    return seen, seen.floor.pose[:3, 2], seen.floor.pose[:3, 2] @ seen.floor.pose[:3, 3]


def evaluate_floors(only="", kinds="", verbose=False):
    """Print for each variant of the labelled frames in how many the floor that is found first is the support's plane.

    That is the one found in the frame as it is, where it passes the labelled pixel; in a variant it is to pass within
    SUPPORT of half of its pixels that are seen, where these are SOME of all. Takes what `evaluate_frames` does.
    """
    labels, folder = labelled_frames()
    frames = {name: read_frame(folder, name, labels[name]) for name in names_in(only, labels, "frame")}
    variants = names_in(kinds, VARIANTS, "variant")
    lies = {}
    for name, frame in frames.items():
        _, normal, offset = first_floor(frame)
        if support_met(frame, normal[None], offset):
            lies[name] = np.abs(points_of(frame) @ normal - offset) < 0.5 * SUPPORT
    print(
        f"the support is found in {len(lies)} of {sum(frame.label['support'] is not None for frame in frames.values())}"
    )
    print("| variant | support | not in | seconds |\n" + "|---" * 4 + "|")
    for kind in variants:
        met, began = {}, time.perf_counter()
        for name in lies:
            made = VARIANTS[kind](np.random.default_rng(STREAM), frames[name])
            there = lies[name][made.source[..., 0], made.source[..., 1]] & np.isfinite(made.depth)
            if there.mean() < SOME:
                continue
            seen, normal, offset = first_floor(made)
            off = np.abs(points_of(made)[there] @ normal - offset)
            met[name] = bool(np.median(off) < SUPPORT * made.scale)
            if verbose:
                print(f"{name} {kind}: {met[name]}, seen {there.mean():.2f}, normal {normal.round(2)}, on it "
                      f"{seen.floor.inliers.mean():.2f}, standing {seen.mask.mean():.2f}, "
                      f"behind {seen.background:.2f}", flush=True)  # fmt: skip
        missed = ", ".join(name for name, right in met.items() if not right)
        seconds = time.perf_counter() - began
        print(f"| {kind} | {sum(met.values())} of {len(met)} | {missed} | {seconds:.1f} |", flush=True)


def labelled_frames():
    """Return what labels.json says of each frame, and the folder of the frames."""
    folder = real_folder()
    if folder is None or not (folder / "frames" / "labels.json").exists():
        raise DerenderError("there are no labelled real frames here", "DERENDER_REAL", "name their folder")
    return json.loads((folder / "frames" / "labels.json").read_text()), folder / "frames"


def evaluate_frames(only="", kinds="", keep="", method="auto", verbose=False):
    """Print a row for each variant of the labelled frames.

    only : names of frames, and kinds : of variants, with commas between; none: all. keep : folder of the pictures and
    scores, from which what is there is taken. method : see Options.
    """
    labels, folder = labelled_frames()
    names = names_in(only, labels, "frame")
    variants = names_in(kinds, VARIANTS, "variant")
    scores: dict[str, dict[str, Score]] = {kind: {} for kind in variants}
    for name in names:
        frame = read_frame(folder, name, labels[name])
        for kind in variants:
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
    print(
        "| variant | recall | with difficult | precision | background | nothing | support | changed | trusted | theirs "
        "| trusted solids | there | median, worst s |"
    )
    print("|---" * 13 + "|")
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
                 sum(r.behind for r in every), sum(r.empty for r in every),
                 of_all([r.support for r in every]), share_of(changed, total), of_all([r.trusted for r in every]),
                 share_of(*counts([each for r in full if r.trusted for each in r.told])),
                 of_all([each[1] for r in full for each in r.told]),
                 share_of(*counts([each for r in full for each in r.told if each[1]])),
                 f"{np.median(seconds):.1f}, {max(seconds):.1f}"]  # fmt: skip
        print(f"| {kind} | {' | '.join(map(str, cells))} |", flush=True)
    told = [each for rows in scores.values() for r in rows.values() if r.complete for each in r.told]
    if told:
        said = np.mean([each[0] for each in told])
        print(f"of {len(told)} solids {share_of(*counts(told))} are there, {said:.3f} are said to be: "
              f"calibration error {error_of(told):.3f}")  # fmt: skip
