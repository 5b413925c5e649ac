"""Figures 1 to 3: what the scene graph itself says; no inference."""

from itertools import combinations
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from derender import data_path
from derender.camera.intrinsics import Camera
from derender.document import read_document
from derender.evaluation.convex import intersection_volume
from derender.report.pictures import shade
from derender.scene.contacts import contacts
from derender.scene.graph import SceneGraph
from derender.scene.separation import separation
from derender.scene.shapes import Body, shapes

Rows = list[tuple[str, str, str]]
SCENES = 4000
FLUSH = 1e-6
"""Metres: two solids touch where they are nearer than this, and interpenetrate where they overlap by more."""


def picture(graph: SceneGraph, camera: Camera | None) -> np.ndarray:
    """Return a shaded picture of a scene, about 480 pixels wide; cubes have the colours of their names."""
    assert camera is not None, "the files of the figures name their cameras"
    return shade(graph.solids(), camera.downscaled(1 / max(1, round(480 / camera.width))), graph.solid_names)


def show(axes, image: np.ndarray, title: str = "", colour: str = "#999999") -> None:
    """Put a picture into axes, with a coloured frame."""
    axes.imshow(image)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title(title, fontsize=9)
    for spine in axes.spines.values():
        spine.set_edgecolor(colour)
        spine.set_linewidth(2)


def touching_and_interpenetrating(graph: SceneGraph) -> tuple[int, int, int, int]:
    """Return how many pairs touch (or overlap), and how many of them interpenetrate: with an edge, without one."""
    solids, names = graph.solids(), graph.solid_names
    edges = {frozenset((vertex.name, vertex.parent)) for vertex in graph.vertices}
    found = [0, 0, 0, 0]
    for i, j in combinations(range(len(names)), 2):
        gap = separation(solids, i, j)
        if gap < FLUSH:
            place = 0 if frozenset((names[i], names[j])) in edges else 2
            found[place] += 1
            found[place + 1] += gap < -FLUSH
    return found[0], found[1], found[2], found[3]


def figure_1(path: Path, seed: int) -> Rows:
    """Draw random scenes of three contact graphs, and count how often what touches interpenetrates."""
    rows: Rows = []
    kinds = (("free", "#222222"), ("stack", "#3060d0"), ("two-stacks", "#c030b0"))
    figure, grid = plt.subplots(3, 4, figsize=(11, 6.6))
    for line, (kind, colour) in zip(grid, kinds, strict=True):
        document = read_document(data_path(f"priors/{kind}.yaml"))
        rng = np.random.default_rng(seed)
        graphs = [document.prior.sample(rng) for _ in range(SCENES)]
        counts = np.sum([touching_and_interpenetrating(graph) for graph in graphs], axis=0)
        freedom = {graph.degrees_of_freedom() for graph in graphs}
        (dimensions,) = freedom
        for axes, graph in zip(line[:3], graphs, strict=False):
            show(axes, picture(graph, document.camera), colour=colour)
        line[0].set_ylabel(kind, color=colour, fontsize=12)
        line[3].axis("off")
        words = [f"{dimensions} dimensions"]
        for what, touching, entered in (("joined by an edge", *counts[:2]), ("without an edge", *counts[2:])):
            if touching:
                words.append(f"pairs {what} that touch: {touching}\n  of them interpenetrate: {entered / touching:.1%}")
        line[3].text(0, 0.5, "\n".join(words), va="center", fontsize=9.5)
        paper_dimensions = {"free": "24", "stack": "15", "two-stacks": "15"}[kind]
        rows.append((f"{kind}: dimensions", str(dimensions), paper_dimensions))
        if kind == "free":
            rows.append(
                ("free: touching pairs that interpenetrate", f"{counts[3] / counts[2]:.1%} of {counts[2]}", "all")
            )
        else:
            share = f"{counts[1] / counts[0]:.1%} of {counts[0]}"
            rows.append((f"{kind}: pairs with an edge that interpenetrate", share, "none"))
            share = f"{counts[3] / SCENES:.1%} of {SCENES}"
            paper = "not guaranteed" if kind == "two-stacks" else "none shown"
            rows.append((f"{kind}: scenes in which others enter each other", share, paper))
    figure.suptitle(f"Figure 1: random scenes of three contact graphs ({SCENES} of each counted)", fontsize=11)
    save(figure, path)
    return rows


def figure_2(path: Path, seed: int) -> Rows:
    """Draw the offsets at which two squares touch, and count that (theta, u, v) covers them and nothing else."""
    rng = np.random.default_rng(seed)
    parent, child = 0.12, 0.08
    figure, grid = plt.subplots(1, 3, figsize=(11, 3.9))
    for axes, (theta, u, v) in zip(grid, ((0.35, 0.7, 0.3), (0.9, 0.25, 0.8), (0.35, 1.0, 0.4)), strict=True):
        centre = draw_offsets(axes, parent, child, theta, u, v)
        axes.set_title(
            f"θ = {np.rad2deg(theta):.0f}°, u = {u}, v = {v}: offset ({centre[0]:.3f}, {centre[1]:.3f}) m", fontsize=9
        )
    inside, rim, outside, count = 0, 0, 0, 3000
    for _ in range(count):
        theta, u, v = rng.uniform(0, np.pi / 2), *rng.uniform(0, 1, 2)
        # Square millimetres: far above rounding, far below any face.
        inside += shared_area(parent, child, theta, u, v) > 1e-12
        rim += shared_area(parent, child, theta, u, float(v > 0.5)) < 1e-12
        outside += shared_area(parent, child, theta, u, float(v > 0.5), push=1.001) > 1e-12
    figure.suptitle("Figure 2: the squares of a contact, and the offsets (grey) at which they touch", fontsize=11)
    save(figure, path)
    return [
        ("(theta, u, v) inside: squares share an area", f"{inside / count:.1%} of {count}", "all (by construction)"),
        ("v = 0 or 1: they touch in an edge or a point only", f"{rim / count:.1%} of {count}", "all (by construction)"),
        ("0.1 % beyond: still touching", f"{outside / count:.1%} of {count}", "none (by construction)"),
    ]


def offset(parent: float, child: float, theta: float, u: float, v: float) -> np.ndarray:
    """Return the (4, 4) pose of the child cube in the parent's axes, face to face on top."""
    cube = shapes["cube"]
    below, above = Body(cube, np.array([parent])), Body(cube, np.array([child]))
    return contacts["face-to-face"].relative_pose({"theta": theta, "u": u, "v": v}, below, above, "+z", "-z")


def shared_area(parent: float, child: float, theta: float, u: float, v: float, push: float = 1.0) -> float:
    """Return the area that the two faces share, m^2; `push` scales the offset."""
    pose = offset(parent, child, theta, u, v)
    pose[:2, 3] *= push
    # The child's shadow through the parent: prisms as high as the parent share area times height.
    pose[2, 3] = 0
    solids = [
        {"type": "box", "size": [parent] * 3, "pose": np.eye(4)},
        {"type": "box", "size": [child, child, parent], "pose": pose},
    ]
    return intersection_volume(*solids) / parent


def draw_offsets(axes, parent: float, child: float, theta: float, u: float, v: float) -> np.ndarray:
    """Draw the two squares, the set of touching offsets, and the intervals of x and y; return the offset."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) / 2
    pose = offset(parent, child, theta, u, v)
    centre, turned = pose[:2, 3], child * square @ pose[:2, :2].T
    rim = np.array([offset(parent, child, theta, a, b)[:2, 3] for b in (0.0, 1.0) for a in np.linspace(0, 1, 181)])
    rim = np.vstack([rim[:181], rim[181:][::-1]])
    axes.fill(*rim.T, color="#e4e4e4", zorder=0)
    axes.fill(*(parent * square).T, color="#7aa6e8", alpha=0.8)
    axes.fill(*(turned + centre).T, color="#f2a65a", alpha=0.8)
    low, high = rim[:, 0].min(), rim[:, 0].max()
    axes.plot([low, high], [rim[:, 1].min() * 1.12] * 2, "k|-", lw=1)
    ends = [offset(parent, child, theta, u, b)[:2, 3] for b in (0.0, 1.0)]
    axes.plot(*np.array(ends).T, "k_-", lw=1)
    axes.plot(*centre, "ko", ms=4)
    axes.set_aspect("equal")
    axes.axis("off")
    return centre


def figure_3(path: Path, seed: int) -> Rows:
    """Draw one scene as two graphs, and what happens to each when the green cube's contact is perturbed."""
    contact_document = read_document(data_path("scenes/figure-3-contacts.yaml"))
    contact_graph = contact_document.graph
    free_graph = read_document(data_path("scenes/figure-3-free.yaml")).graph
    poses = [graph.poses() for graph in (contact_graph, free_graph)]
    difference = max(np.abs(poses[0][name] - poses[1][name]).max() for name in contact_graph.names)
    figure, grid = plt.subplots(1, 3, figsize=(11, 3.7))
    show(grid[0], picture(contact_graph, contact_document.camera), "one scene, two graphs")
    moved = {}
    for axes, graph, words in (
        (grid[1], contact_graph, "frame → plane → cube → cube → cube"),
        (grid[2], free_graph, "frame → plane | cube | cube | cube"),
    ):
        before = graph.poses()
        x = graph.vertex("green").contact.values["x"]
        after = graph.with_numbers({"green.contact.x": x - 0.05})
        moved[words] = [name for name in graph.names if not np.allclose(after.poses()[name], before[name], atol=1e-9)]
        show(
            axes,
            picture(after, contact_document.camera),
            f"{words}\n{graph.degrees_of_freedom()} dimensions; φ₃ perturbed",
        )
    figure.suptitle("Figure 3: one physical scene as two scene graphs", fontsize=11)
    save(figure, path)
    with_contacts, free = moved.values()
    return [
        ("dimensions with contacts", str(contact_graph.degrees_of_freedom()), "15"),
        ("dimensions with free poses", str(free_graph.degrees_of_freedom()), "24"),
        ("largest difference of poses", f"{difference:.1e}", "0"),
        ("moved by phi_3, with contacts", ", ".join(with_contacts), "3, 4, 5"),
        ("moved by phi_3, free", ", ".join(free), "3"),
    ]


def save(figure, path: Path) -> None:
    """Write a figure as PNG and let go of it."""
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)
