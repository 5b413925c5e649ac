"""Make films of moving solids with known truth: slide, slope, bounce, collide, topple, place, push.

Three kinds more show a hand: cover (it comes over what rests, and leaves again), pick (it takes a thing and places it
elsewhere) and shove (it pushes one).

    python scripts/sequences.py DIR                       one of each kind: DIR/slide_000/ and so on
    python scripts/sequences.py DIR bounce topple -n 5    five of each of two kinds

A folder holds frame_000.npy ... (float32 metres, NaN where nothing returned), camera.json (with `fps` and `gravity`,
m/s^2 in camera axes) and truth.json: in the form of track.json, and beside its keys `kind`, `fps`, `gravity`,
`materials` (friction, restitution, kg of each object), `floor` (4x4, to camera),
`speeds` of each object at the first frame (linear, angular, in camera axes) and `pixels` of it in each frame. Physics
is MuJoCo's at steps of a quarter of a millisecond; parents are what bears a thing, hops of millimetres apart;
`restitution` is that of the first impact as it was, where a bounce is the film's subject; elsewhere that of contacts as
soft as can be.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from arguments import at_least_one

from derender.atomic import make_folder
from derender.camera.sensor import SENSORS, find_sensor
from derender.cli import status_of
from worlds.films import GRAVITY, hand_of, without_hops
from worlds.made_scenes import camera_of, look_at

KINDS = ("slide", "slope", "bounce", "collide", "topple", "place", "push")
HANDS = ("cover", "pick", "shove")
FILMS = KINDS + HANDS  # its place among these is part of a film's seed
FRAMES, SIZE = 24, (160, 120)
HAND_FRAMES = 60  # of a film of a hand: it takes half a second to come and to go
AWAY = 0.7  # metres from the thing at which a hand begins and ends
STEP = 0.00025  # seconds
DENSITY = 500.0  # kg / m^3
CONTACT_TIME = 0.002  # seconds, of a contact's spring: an impact is over within a few
TOUCH = 0.0005  # metres: nearer than that two things touch, also where a sliding one hops for a step
# Restitution of contacts for which none is asked: balls and boxes of 5 to 9 cm, dropped by 1 to 10 cm, leave with .14
# to .12 of their speed.
LEAST_RESTITUTION = 0.13
IMPACT = 0.01  # seconds, within which an impact is over
LEAD = 0.01  # seconds before the first frame, in which contacts come to bear: friction is less for the first 5 ms
BEARS = 0.5  # share of the steps about a frame in which a pair must touch to count as a contact
BELOW = 0.3  # of a contact's normal, how much of it must point up for one thing to stand on the other


class Film:
    """A world that is stepped, and what is kept of it at each frame.

    Parameters
    ----------
    items : dicts with type, size (3,), pose (4, 4) object to world (z up along the floor's normal), and optionally
        velocity (3,), spin (3,), density, restitution.
    friction : of every pair. tilt : radians between the floor's normal and up, about the world's y axis.
    hand : None, or a function of (seconds) that returns (index, pose (4, 4), pushing) of what an unseen hand holds or
        of the unseen pusher, or None.
    arm : None, or a function of (seconds) that returns the spheres (K, 4) of a hand that is seen, in the world.
    frames : how many the film has.
    """

    def __init__(self, items, friction, tilt=0.0, hand=None, pusher=None, arm=None, frames=FRAMES) -> None:
        import mujoco

        self.mujoco, self.items, self.hand, self.pusher = mujoco, items, hand, pusher
        self.friction, self.arm, self.frames = friction, arm, frames
        self.down = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
        bodies, pairs = "", ""
        for k, item in enumerate(items):
            half = np.asarray(item["size"]) / 2
            shape, extent = {"sphere": ("sphere", f"{half[0]}"), "cylinder": ("cylinder", f"{half[0]} {half[2]}")}.get(
                item["type"], ("box", " ".join(map(str, half)))
            )
            bodies += f'<body name="b{k}"><freejoint/><geom name="g{k}" type="{shape}" size="{extent}" '
            bodies += f'density="{item.get("density", DENSITY)}"/></body>'
            for other in ["floor", *(f"g{j}" for j in range(k))]:
                elastic = max(item.get("restitution", 0.0), 0.0)
                pairs += pair_of(other, f"g{k}", friction, elastic)
        if pusher is not None:
            bodies += (
                f'<body name="pusher" mocap="true" pos="0 0 -5"><geom name="p" type="sphere" size="{pusher}"/></body>'
            )
            pairs += "".join(pair_of("p", f"g{k}", 0.3, 0.0) for k in range(len(items)))
        down = " ".join(map(str, GRAVITY * self.down))
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><option timestep="{STEP}" gravity="{down}" cone="elliptic" impratio="10"/><worldbody>'
            f'<geom name="floor" type="plane" size="3 3 .1"/>{bodies}</worldbody><contact>{pairs}</contact></mujoco>'
        )
        self.data = mujoco.MjData(self.model)
        for k, item in enumerate(items):
            self.put(k, item["pose"], item.get("velocity", np.zeros(3)), item.get("spin", np.zeros(3)))
        mujoco.mj_forward(self.model, self.data)

    def put(self, k, pose, velocity, spin):
        quaternion = np.empty(4)
        self.mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(pose[:3, :3]).ravel())
        self.data.qpos[7 * k : 7 * k + 7] = [*pose[:3, 3], *quaternion]
        self.data.qvel[6 * k : 6 * k + 6] = [*velocity, *(pose[:3, :3].T @ spin)]

    def poses(self):
        poses = np.tile(np.eye(4), (len(self.items), 1, 1))
        count = len(self.items) + 1
        poses[:, :3, 3] = self.data.xpos[1:count]
        poses[:, :3, :3] = self.data.xmat[1:count].reshape(-1, 3, 3)
        return poses

    def support(self):
        """Return (N, N + 1) bool, what stands on what, and newtons upward that it bears of it; column 0: the floor."""
        count = len(self.items)
        lift, touch, force = np.zeros((count, count + 1)), np.zeros((count, count + 1), bool), np.zeros(6)
        for index in range(self.data.ncon):
            contact = self.data.contact[index]
            first, second = (int(self.model.geom_bodyid[g]) for g in (contact.geom1, contact.geom2))
            if max(first, second) > count:  # the pusher
                continue
            self.mujoco.mj_contactForce(self.model, self.data, index, force)
            upward = -(contact.frame.reshape(3, 3).T @ force[:3])[2] * np.sign(self.down[2])
            up = contact.frame[2]  # of the normal, from the first to the second
            if second > 0:
                lift[second - 1, first] += upward
                touch[second - 1, first] |= up > BELOW
            if first > 0:
                lift[first - 1, second] -= upward
                touch[first - 1, second] |= -up > BELOW
        return touch, lift

    def run(self, fps):
        """Return (poses (T, N, 4, 4), parents [T][N] of -1 floor, an index or None, velocities (T, N, 6))."""
        steps = round(1.0 / fps / STEP)
        held, heights = None, []
        poses, velocities, touched, load = [], [], [], []
        for step in range(-round(LEAD / STEP), self.frames * steps):
            if step >= 0 and step % steps == 0:
                poses.append(self.poses())
                velocities.append(self.data.qvel[: 6 * len(self.items)].reshape(-1, 6).copy())
            if self.hand is not None:
                held = self.hand(max(step, 0) * STEP)
                if held is not None and self.pusher is not None:
                    self.data.mocap_pos[0] = held[1][:3, 3]
                elif self.pusher is not None:
                    self.data.mocap_pos[0] = [0.0, 0.0, -5.0]
                elif held is not None:
                    ahead = self.hand(max(step + 1, 0) * STEP)
                    speed = np.zeros(3) if ahead is None else (ahead[1][:3, 3] - held[1][:3, 3]) / STEP
                    self.put(held[0], held[1], speed, np.zeros(3))
            self.mujoco.mj_step(self.model, self.data)
            if step < 0:
                continue
            heights.append(self.data.qvel[2])
            touch, lift = self.support()
            if held is not None and self.pusher is None:
                touch[held[0]] = False
            touched.append(touch)
            load.append(lift)
        self.restitution = restitution_of(np.array(heights))
        parents, touched = [], without_hops(np.array(touched), STEP)
        for frame in range(self.frames):
            window = slice(max(frame * steps - steps // 2, 0), frame * steps + steps // 2)
            share, mean = np.mean(touched[window], axis=0), np.mean(load[window], axis=0)
            row = []
            for k in range(len(self.items)):
                best = int(np.argmax(np.where(share[k] >= BEARS, mean[k], -np.inf)))
                row.append(best - 1 if share[k, best] >= BEARS else None)
            parents.append(row)
        return np.array(poses), parents, np.array(velocities)


def restitution_of(speeds):
    """Return upward over downward speed at the first impact of a film's upward speeds at its steps; NaN for none."""
    window = int(IMPACT / STEP)
    turns = np.flatnonzero((speeds[:-window] < 0) & (speeds[window:] > 0))
    if len(turns) == 0:
        return float("nan")
    about = speeds[turns[0] : turns[0] + 2 * window]
    return float(about.max() / -about.min())


def pair_of(first, second, friction, restitution):
    """Return the MJCF of a pair whose spring gives back `restitution` of the speed of an impact."""
    damping = 1.0
    if restitution > 0:
        damping = float(-np.log(restitution) / np.hypot(np.pi, np.log(restitution)))
    return (
        f'<pair geom1="{first}" geom2="{second}" condim="4" friction="{friction} {friction} 0.002 0.0001 0.0001" '
        f'solref="{CONTACT_TIME / damping} {damping}" solreffriction="{CONTACT_TIME} 1" gap="{TOUCH}" '
        'solimp="0.95 0.99 0.0005"/>'
    )


def turned(yaw, position, lean=0.0):
    """Return the pose (4, 4) of something turned about z, then leant about the world's y axis."""
    c, s, d, e = np.cos(yaw), np.sin(yaw), np.cos(lean), np.sin(lean)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[d, 0, e], [0, 1, 0], [-e, 0, d]]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    pose[:3, 3] = position
    return pose


def block(rng, x, y, low=0.05, high=0.12, bottom=0.0, kind="box", **more):
    """Return an upright solid at (x, y) that stands at height `bottom`."""
    size = rng.uniform(low, high, 3)
    if kind == "sphere":
        size[:] = size[0]
    elif kind == "cylinder":
        size[1] = size[0]
    pose = turned(rng.uniform(0, np.pi), [x, y, bottom + size[2] / 2])
    return {"type": kind, "size": size, "pose": pose, **more}


def smooth(share):
    """Return 0 to 1 with no speed at either end."""
    share = np.clip(share, 0.0, 1.0)
    return share * share * (3.0 - 2.0 * share)


def script(rng, kind, fps):
    """Return (Film, parameters) of one sequence."""
    seconds = FRAMES / fps
    friction, told = rng.uniform(0.15, 0.6), {}
    stander = lambda x, y: block(rng, x, y)  # noqa: E731
    heading = rng.uniform(0, 2 * np.pi)
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    aside = np.array([-ahead[1], ahead[0], 0.0])
    if kind == "slide":
        speed = rng.uniform(0.35, 1.1)
        start = -ahead * 0.5 * min(speed**2 / (2 * friction * GRAVITY), speed * seconds)
        mover = block(rng, *start[:2], velocity=speed * ahead, spin=np.array([0, 0, rng.normal(0, 2.0)]))
        items = [mover] + [stander(*(aside * rng.uniform(0.15, 0.22))[:2]) for _ in range(int(rng.integers(0, 2)))]
        return Film(items, friction), {"friction": friction}
    if kind == "slope":
        tilt = np.radians(rng.uniform(8, 28))
        speed, friction = rng.uniform(0.0, 0.5), np.tan(tilt) * rng.uniform(0.3, 1.1)
        mover = block(rng, -0.12, rng.uniform(-0.03, 0.03), velocity=np.array([speed, 0, 0]))
        return Film([mover], friction, tilt), {"friction": friction}
    if kind == "bounce":
        shape = str(rng.choice(["sphere", "sphere", "box"]))
        told["restitution"] = rng.uniform(0.3, 0.8)
        mover = block(rng, 0.0, 0.0, 0.05, 0.10, rng.uniform(0.04, 0.16), shape, restitution=told["restitution"])
        mover["velocity"] = ahead * rng.uniform(0, 0.4)
        mover["pose"][:3, 3] -= mover["velocity"] * seconds / 2
        others = [stander(*(aside * 0.2)[:2])] if rng.random() < 0.5 else []
        return Film([mover, *others], friction), told
    if kind == "collide":
        speed = rng.uniform(0.6, 1.2)
        first = block(rng, *(-ahead * 0.2)[:2], 0.06, 0.11, velocity=speed * ahead, density=rng.uniform(200, 1200))
        second = block(rng, *(aside * rng.uniform(-0.02, 0.02))[:2], 0.06, 0.11, density=rng.uniform(200, 1200))
        masses = [float(item["density"] * np.prod(item["size"])) for item in (first, second)]
        told["mass_ratio"] = {"of": "box_2", "to": "box_1", "mean": masses[1] / masses[0]}
        friction = rng.uniform(0.15, 0.35)
        return Film([first, second], friction), {"friction": friction, **told}
    if kind == "topple":
        count, items, bottom = int(rng.integers(1, 4)), [], 0.0
        for k in range(count):
            item = block(rng, *rng.uniform(-0.01, 0.01, 2), 0.05, 0.09, bottom)
            if count == 1:
                item["size"][2] = rng.uniform(0.14, 0.2)
                item["pose"][2, 3] = item["size"][2] / 2
            bottom += item["size"][2]
            if k == count - 1:
                item["velocity"] = ahead * rng.uniform(0.5, 0.9)
                if count == 1:
                    item["spin"] = np.cross([0, 0, 1], ahead) * rng.uniform(7, 9)
                    item["velocity"] = np.cross(item["spin"], [0, 0, item["size"][2] / 2])
            items.append(item)
        return Film(items, rng.uniform(0.4, 0.8)), {}
    if kind == "place":
        base = block(rng, 0.0, 0.0, 0.07, 0.13)
        top = bool(rng.random() < 0.6)
        goal = np.array([0, 0, base["size"][2]]) if top else ahead * rng.uniform(0.14, 0.2)
        mover = block(rng, *goal[:2], 0.04, 0.09)
        final = mover["pose"].copy()
        final[2, 3] = goal[2] + mover["size"][2] / 2 + 5e-4
        lifted = bool(rng.random() < 0.4)  # taken from the floor in sight, or there from the start in the hand
        origin = final[:3, 3] + aside * rng.uniform(0.15, 0.2) + [0, 0, rng.uniform(0.05, 0.12)]
        if lifted:
            origin[2] = mover["size"][2] / 2
        mover["pose"] = turned(0.0, origin)
        mover["pose"][:3, :3] = final[:3, :3]
        begin, end = seconds * (0.15 if lifted else 0.0), seconds * rng.uniform(0.6, 0.8)
        high = max(origin[2], final[2, 3]) + rng.uniform(0.03, 0.06)

        def hand(time):
            if not begin <= time < end:
                return None
            share = (time - begin) / (end - begin)
            pose = final.copy()
            across = smooth((share - 0.2) / 0.55)
            pose[:2, 3] = origin[:2] + across * (final[:2, 3] - origin[:2])
            up = origin[2] + smooth(share / 0.35) * (high - origin[2])
            pose[2, 3] = up + smooth((share - 0.65) / 0.35) * (final[2, 3] - high)
            return 1, pose, False

        return Film([base, mover], friction, hand=hand), {}
    speed, radius = rng.uniform(0.2, 0.5), 0.02
    mover = block(rng, *(-ahead * 0.08)[:2])
    others = [stander(*(ahead * rng.uniform(0.1, 0.16))[:2])] if rng.random() < 0.6 else []
    reach = np.linalg.norm(mover["size"][:2]) / 2 + radius + 0.002
    begin, end = seconds * 0.1, seconds * rng.uniform(0.5, 0.8)

    def pushing(time):
        if not begin <= time < end:
            return None
        pose = np.eye(4)
        pose[:3, 3] = mover["pose"][:3, 3] - ahead * (reach - speed * (time - begin))
        pose[2, 3] = mover["size"][2] * 0.4
        return -1, pose, True

    return Film([mover, *others], friction, hand=pushing, pusher=radius), {"friction": friction}


def hand_script(rng, kind, fps):
    """Return the Film of a seen hand that covers, picks or shoves (kind) the first thing; fps : frames a second.

    The hand is spheres. A thing that is picked is held by it as place's is; one that is shoved is pushed by a sphere
    between the fingertips that is itself not seen.
    """
    seconds, friction = HAND_FRAMES / fps, rng.uniform(0.2, 0.6)
    heading = rng.uniform(0, 2 * np.pi)
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    aside = np.array([-ahead[1], ahead[0], 0.0])
    dip = np.radians(rng.uniform(25, 60))
    along = np.cos(dip) * ahead - [0.0, 0.0, np.sin(dip)]  # from the wrist to the fingertips
    axes = np.stack([along, aside, np.cross(along, aside)], axis=1)
    mover = block(
        rng, 0.0, 0.0, 0.05, 0.09, kind=str(rng.choice(["box", "box", "cylinder"])) if kind != "shove" else "box"
    )
    mover["pose"][:3, :3] = turned(heading, np.zeros(3))[:3, :3]
    size = mover["size"]
    others = [block(rng, *(side * aside * rng.uniform(0.14, 0.2))[:2]) for side in (-1, 1)[: int(rng.integers(1, 3))]]
    items, hand, pusher = [mover, *others], None, None
    begin, end = seconds * rng.uniform(0.25, 0.35), seconds * rng.uniform(0.6, 0.7)
    share = lambda time: np.clip((time - begin) / (end - begin), 0.0, 1.0)  # noqa: E731
    if kind == "cover":
        spheres = hand_of(rng, rng.uniform(0.02, 0.05))
        ends = [rng.uniform(-1, 1) * 0.12 * aside + [0, 0, size[2] + rng.uniform(0.025, 0.07)] for _ in range(2)]
        place = lambda time: ends[0] + smooth(share(time)) * (ends[1] - ends[0])  # noqa: E731
    elif kind == "pick":
        spheres = hand_of(rng, size[1])
        goal = -ahead * rng.uniform(0.0, 0.15) + aside * rng.choice([-1, 1]) * rng.uniform(0.0, 0.05)
        support = 0.0
        if rng.random() < 0.5:
            goal, support = others[0]["pose"][:3, 3] * [1, 1, 0], others[0]["size"][2]
        high = support + rng.uniform(0.03, 0.08)

        def held(time):
            part, pose = share(time), mover["pose"].copy()
            pose[:3, 3] += smooth((part - 0.2) / 0.55) * goal
            pose[2, 3] += smooth(part / 0.35) * high + smooth((part - 0.65) / 0.35) * (support + 5e-4 - high)
            return pose

        hand = lambda time: (0, held(time), False) if begin <= time < end else None  # noqa: E731
        place = lambda time: held(time)[:3, 3] + [0, 0, 0.2 * size[2]]  # noqa: E731
    else:
        spheres, pusher = hand_of(rng, 0.015), 0.012
        reach = np.linalg.norm(size[:2]) / 2 + pusher + 0.02
        middle = mover["pose"][:3, 3] * [1, 1, 0.8]
        way = rng.uniform(0.06, 0.14) + 0.02
        place = lambda time: middle + ahead * (smooth(share(time)) * way - reach)  # noqa: E731

        def hand(time):
            pose = np.eye(4)
            pose[:3, 3] = place(time)
            return (-1, pose, True) if begin <= time < end else None

    def arm(time):
        out = AWAY * (1 - smooth(time / begin) if time < begin else smooth((time - end) / (seconds - end)))
        centres = spheres[:, :3] @ axes.T + place(time) - out * along
        return np.column_stack([centres, spheres[:, 3]])

    return Film(items, friction, hand=hand, pusher=pusher, arm=arm, frames=HAND_FRAMES)


def make_sequence(rng, kind, sensor="kinect", motion=0.0, size=SIZE, fps=None):
    """Return (frames (T, H, W) float32, camera dict with fps and gravity, truth dict) of one sequence.

    sensor : a name of derender.camera.sensor, or "plain": 1 mm of white noise. motion : metres that the camera goes
    round the scene in a second. size : (width, height) in pixels. fps : frames a second; None: as the kind has it.
    """
    while True:
        usual = float(rng.choice([24.0, 30.0, 30.0, 60.0] if kind in ("collide", "bounce", "topple") else [24.0, 30.0]))
        rate = fps or usual
        film, parameters = (hand_script(rng, kind, rate), {}) if kind in HANDS else script(rng, kind, rate)
        poses, parents, velocities = film.run(rate)
        if "restitution" in parameters:
            parameters["restitution"] = film.restitution
        middle = poses[:, :, :3, 3].reshape(-1, 3).mean(0)
        distance, elevation = rng.uniform(0.65, 0.95), np.radians(rng.uniform(22, 50))
        view = look_at(rng, distance, elevation, middle)
        camera = camera_of(*size)
        views = [swung(view, middle, motion * t / rate / distance) for t in range(film.frames)]
        seen = [photographed(film, w, p, t / rate, camera) for t, (w, p) in enumerate(zip(views, poses, strict=True))]
        pixels = np.array([[int((label == k).sum()) for k in range(len(film.items))] for _, label in seen])
        if (
            np.isfinite([*poses.ravel(), parameters.get("restitution", 0.0)]).all()
            and pixels[0].min() >= 100
            and (pixels.min() >= 1 or film.arm is not None)
        ):
            break
    model = find_sensor(sensor) if sensor != "plain" else None
    frames = np.array(
        [model.observe(rng, depth) if model else depth + 0.001 * rng.standard_normal(depth.shape) for depth, _ in seen],
        np.float32,
    )
    names = named([item["type"] for item in film.items])
    objects = []
    for k, (name, item) in enumerate(zip(names, film.items, strict=True)):
        over = [None if row[k] is None else "floor" if row[k] < 0 else names[row[k]] for row in parents]
        objects.append(
            {
                "name": name, "type": item["type"], "size": list(map(float, item["size"])),
                "poses": [(w @ p[k]).tolist() for w, p in zip(views, poses, strict=True)], "parents": over,
            }
        )  # fmt: skip
    turn = view[:3, :3]
    starts = [
        {"linear": (turn @ v[:3]).tolist(), "angular": (turn @ p[:3, :3] @ v[3:]).tolist()}
        for v, p in zip(velocities[0], poses[0], strict=True)
    ]
    told = {key: value if isinstance(value, dict) else {"mean": value} for key, value in parameters.items()}
    masses = {name: float(mass) for name, mass in zip(names, film.model.body_mass[1:], strict=False)}
    restitution = parameters.get("restitution", LEAST_RESTITUTION)
    materials = {"friction": film.friction, "restitution": restitution, "masses": masses}
    gravity = (GRAVITY * turn @ film.down).tolist()
    truth = {
        "objects": objects, "parameters": told, "materials": materials, "kind": kind, "fps": rate, "gravity": gravity,
        "floor": view.tolist(), "views": [w.tolist() for w in views], "speeds": starts, "pixels": pixels.tolist(),
    }  # fmt: skip
    return frames, {**camera.to_dict(), "fps": rate, "gravity": gravity}, truth


def photographed(film, view, poses, time, camera):
    """Return depth and label (H, W) of a film's things, and of the hand that is seen, at a time."""
    from worlds.made_scenes import render_floor_scene

    kinds, sizes = [item["type"] for item in film.items], [item["size"] for item in film.items]
    posed = view @ poses
    if film.arm is not None:
        spheres = film.arm(time)
        there = np.tile(np.eye(4), (len(spheres), 1, 1))
        there[:, :3, 3] = spheres[:, :3]
        posed = np.concatenate([posed, view @ there])
        kinds, sizes = (
            kinds + ["sphere"] * len(spheres),
            [*sizes, *(np.full(3, 2 * radius) for radius in spheres[:, 3])],
        )
    return render_floor_scene(kinds, posed, sizes, view, camera)


def named(kinds):
    """Return box_1, box_2, sphere_1, ...: a name for each of these kinds."""
    return [f"{kind}_{kinds[: k + 1].count(kind)}" for k, kind in enumerate(kinds)]


def swung(view, middle, angle):
    """Return the view of a camera that has gone round the vertical through `middle` by an angle."""
    there, back = np.eye(4), np.eye(4)
    there[:3, 3], back[:3, 3] = middle, -middle
    return view @ there @ turned(angle, [0.0, 0.0, 0.0]) @ back


def write_sequence(folder, frames, camera, truth):
    """Write a sequence into a folder, which is made."""
    folder = make_folder(folder)
    for t, frame in enumerate(frames):
        np.save(folder / f"frame_{t:03d}.npy", frame)
    (folder / "camera.json").write_text(json.dumps(camera))
    (folder / "truth.json").write_text(json.dumps(truth))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder")
    parser.add_argument("kinds", nargs="*", help=f"of {', '.join(FILMS)}; default: all")
    parser.add_argument("-n", type=at_least_one, default=1, help="sequences of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first one (its seed)")
    parser.add_argument("--sensor", default="kinect", choices=[*SENSORS, "plain"])
    parser.add_argument("--motion", type=float, default=0.0, help="metres a second that the camera moves")
    arguments = parser.parse_args()
    for kind in arguments.kinds or FILMS:
        if kind not in FILMS:
            parser.error(f"no such kind: {kind}")
        for k in range(arguments.first, arguments.first + arguments.n):
            rng = np.random.default_rng([k, FILMS.index(kind)])
            made = make_sequence(rng, kind, arguments.sensor, arguments.motion)
            write_sequence(Path(arguments.folder) / f"{kind}_{k:03d}", *made)


if __name__ == "__main__":
    sys.exit(status_of(main))
