"""Figures 4 and 5: inference with a given structure, by chains and by gradient ascent."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from figure_scenes import Rows, picture, save, show

from derender import data_path
from derender.document import read_document
from derender.physics.bodies import matter_of_graph
from derender.physics.outcome import probability
from derender.physics.simulate import judge, simulate
from derender.posterior.ascent import Ascent, MapProblem
from derender.posterior.forward import draw_documents, observe
from derender.posterior.sampler import read_settings
from derender.render.raycast.depth import render_depth
from derender.report.animation import frames
from derender.report.pictures import DEPTH_ANCHORS, depth_limits, paint
from derender.structures.given import infer_scene, targets
from derender.structures.options import Options

JOBS = 2
TIMES = (0.0, 0.3, 0.6, 1.2)
"""Seconds after the start at which Figure 4 shows the simulation."""
ASCENTS = 10
SHOWN_STEPS = (0, 2, 8, 12)
STEP_LENGTH = 0.05
CHAINS: Any = {"chains": 4, "draws": 1000, "warmup": 500}


def figure_4(path: Path, seed: int) -> Rows:
    """Infer a tower of four cubes from a low-resolution noisy depth image, and simulate what was inferred."""
    document = read_document(data_path("priors/figure-4.yaml"))
    (truth,) = draw_documents(document, 1, seed, {})
    camera = truth.camera
    clean, _ = render_depth(truth.graph.solids(), camera)
    depth = observe(truth.rng, clean, truth.likelihood)
    settings = read_settings(document.inference)._replace(**CHAINS)
    posterior, _, _ = infer_scene(document, depth, camera, settings, Options("mcmc", seed=seed, jobs=JOBS))
    best = posterior.best_graph()
    true_verdict, verdict = (judge(simulate(matter_of_graph(graph))) for graph in (truth.graph, best))
    drawn = posterior.graphs(np.random.default_rng(seed), 60)
    share = probability(drawn, "stands", jobs=JOBS).probability
    errors = [
        1000 * np.linalg.norm(graph.poses()[name][:3, 3] - truth.graph.poses()[name][:3, 3])
        for graph in drawn
        for name in graph.names
        if name != "floor"
    ]
    trajectory = simulate(matter_of_graph(best), max(TIMES))
    moving = frames(best.solids(), best.solid_names, trajectory, camera)
    figure, grid = plt.subplots(2, 4, figsize=(11, 6.4))
    show(grid[0, 0], paint(depth, *depth_limits(depth, clean < 1.2), DEPTH_ANCHORS), "observed depth, 64 × 64")
    show(grid[0, 1], picture(truth.graph, camera), "truth (never seen)")
    for axes, graph in zip(grid[0, 2:], drawn, strict=False):
        show(axes, picture(graph, camera), "a draw of the posterior", "#3060d0")
    for axes, moment in zip(grid[1], TIMES, strict=True):
        image = moving[min(len(moving) - 1, round(moment * 20))]
        show(axes, image, f"inferred scene simulated, t = {moment:g} s", "#30a050" if verdict.stable else "#c04030")
    words = "stands" if verdict.stable else "falls"
    figure.suptitle(f"Figure 4: the tower {words}; P(stable) = {share:.2f}", fontsize=11)
    save(figure, path)
    density = posterior.best_part.log_density
    return [
        ("unknown contact parameters", str(len(posterior.best_part.addresses)), "12"),
        ("median error of the cubes' places over draws", f"{np.median(errors):.1f} mm", "not given"),
        ("best log density over chains, spread", f"{np.ptp(density.max(axis=1)):.2f} nats", "not given"),
        ("verdict on the inferred scene", words, "shown falling"),
        ("verdict on the truth", "stands" if true_verdict.stable else "falls", "not given"),
        ("P(stable) over the posterior", f"{share:.2f}", "not given"),
    ]


def fixed_steps(scene: MapProblem, start: np.ndarray, iterations: int) -> Ascent:
    """Ascend the log density by steps of fixed length along its gradient in unit coordinates.

    Each parameter is measured by its range (an angle by its period), the gradient is normalised: then the paper's alpha
    is a length. The paper does not say what it multiplies. Of nine readings (the plain gradient with sigma from 1 cm to
    1 m or its mean over pixels, unit length in ranges or in radians, each number by itself) those with unit length
    climb most, nine tenths of the way in 12 steps; plain gradients leap past the top and end below the start; none
    comes within 3 nats in 100 ascents, as steps of fixed length end in a circle about the top.
    """
    domain = scene.domain
    scale = np.where(domain.period > 0.0, domain.period, np.minimum(domain.upper - domain.lower, 1.0))
    path = [domain.bring(start)]
    for _ in range(iterations):
        gradient = scale * scene.slope(path[-1])[0]
        path.append(domain.bring(path[-1] + STEP_LENGTH * scale * gradient / np.linalg.norm(gradient)))
    return Ascent(np.array(path), np.array([scene.log_density(place) for place in path]))


def figure_5(path: Path, seed: int) -> Rows:
    """Ascend the posterior of the yellow cube's (theta, u, v) from ten random starts: the paper's steps, and ours."""
    document = read_document(data_path("priors/figure-5.yaml"))
    (truth,) = draw_documents(document, 1, seed, {})
    camera = truth.camera
    clean, _ = render_depth(truth.graph.solids(), camera, antialias=8)
    depth = observe(truth.rng, clean, truth.likelihood)
    ((target, _),) = targets(document, depth, camera, seed)
    scene = MapProblem(target, target.values(truth.graph))
    starts = np.random.default_rng(seed).uniform(*scene.domain[:2], (ASCENTS, len(scene.start)))
    steps = [fixed_steps(scene, start, 30) for start in starts]
    newton = [scene.maximise(start, iterations=15, tolerance=1e-3) for start in starts]
    best = scene.maximise(scene.start, iterations=15, tolerance=1e-3).densities[-1]
    # Two nats for each of three parameters: where a posterior's draws are, an optimum is found.
    found = [int(np.argmax(heights > best - 6)) if heights.max() > best - 6 else None for _, heights in newton]
    climbed = [heights[min(12, len(heights) - 1)] for _, heights in steps]
    shown = int(np.argmax(climbed))
    figure = plt.figure(figsize=(11, 6))
    grid = figure.add_gridspec(2, 5, width_ratios=(1, 1, 1, 1, 1))
    show(figure.add_subplot(grid[0, 0]), picture(truth.graph, camera), "observed (in colour)")
    for place, number in enumerate(SHOWN_STEPS):
        graph = target.graph(scene.at(steps[shown][0][number]))
        show(figure.add_subplot(grid[0, 1 + place]), picture(graph, camera), f"t = {number} steps", "#3060d0")
    for place, (runs, words) in enumerate(((steps, f"fixed steps of {STEP_LENGTH}"), (newton, "Gauss-Newton"))):
        axes = figure.add_subplot(grid[1, :3] if place == 0 else grid[1, 3:])
        for number, (_, heights) in enumerate(runs):
            axes.plot(heights - best, lw=2.2 if number == shown else 1.1)
        axes.set_yscale("symlog", linthresh=10)
        axes.set_xlabel("step")
        axes.set_ylabel("log likelihood below the optimum, nats")
        axes.set_title(f"{ASCENTS} random starts, {words}", fontsize=9)
        axes.grid(alpha=0.3)
    figure.suptitle("Figure 5: the yellow cube's (θ, u, v) on the red one by gradient ascent", fontsize=11)
    save(figure, path)
    start_gap = best - np.array([heights[0] for _, heights in steps])
    gained = 1 - (best - np.array(climbed)) / start_gap
    reached = [number for number in found if number is not None]
    return [
        ("fixed steps: share of the gap closed in 12, median", f"{np.median(gained):.1%}", "converged after 12"),
        ("fixed steps: starts that close 95 % of it in 12", f"{np.sum(gained > 0.95)} of {ASCENTS}", "not given"),
        ("Gauss-Newton: starts that reach the optimum", f"{len(reached)} of {ASCENTS}", "(not in the paper)"),
        ("Gauss-Newton: steps until there, median", f"{np.median(reached) if reached else np.nan:g}", "(12)"),
    ]
