"""Kernels compiled by a second process while the first one compiles others: half the wait at the first use.

A command says with `precompile` what it will need late. If it comes to compile anything, a process starts that
compiles that, on a scene of a few pixels; the kernels reach the command through the cache (compilation/cache.py), which
lets no two processes compile the same one.
"""

import functools
import os
import subprocess
import sys
import threading

from derender.compilation.cache import when_compiling

WIDTH, HEIGHT = 32, 24  # pixels of the images that are only there to be compiled for


def precompile(name: str) -> None:
    """Have the kernels of one of PARTS compiled beside this process, should it compile any; with one processor, not."""
    if len(os.sched_getaffinity(0)) > 1 if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1) > 1:
        when_compiling(functools.partial(_start, name))


@functools.cache  # it keeps the pipe to the other process open as long as this one lives
def _start(name: str) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-P", "-m", "derender.structures.precompile", name], stdin=subprocess.PIPE,
                            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)  # fmt: skip


def _leave_with_parent() -> None:
    """End this process when the one that started it has gone: its end of the pipe is closed then."""
    sys.stdin.read()
    os._exit(0)


def draws_on_a_floor() -> None:
    """Compile what draws from the posterior of solids found in a bare image."""
    import numpy as np

    from derender.camera.intrinsics import Camera
    from derender.detection.solids.beliefs import Rules
    from derender.detection.solids.graph import names_of
    from derender.detection.solids.image import make_row
    from derender.detection.solids.polish import SLACK, UPRIGHT
    from derender.detection.solids.state import State
    from derender.render.likelihoods import likelihoods
    from derender.scene.pose import rotation_x, translation
    from derender.scene.solids import BOX
    from derender.structures.draws import metropolis
    from derender.structures.draws.chart import make_chart
    from derender.structures.draws.refined import only_draw, refined_at, structure_posterior
    from derender.structures.draws.sensor import Sensor, model_depth
    from derender.structures.draws.steps import single_steps

    camera = Camera(WIDTH, WIDTH, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    floor = translation(0.0, 0.0, 0.8) @ rotation_x(np.radians(125.0))
    row = make_row(BOX, np.eye(3), np.array([0.0, 0.0, 0.05]), np.full(3, 0.1))
    state = State().add(row, UPRIGHT, False, bottom=0.0)
    chart, values = make_chart(state, floor, Rules(SLACK))
    sensor = Sensor(camera, np.full((HEIGHT, WIDTH), 0.8), likelihoods["robust"], {})
    sensor = sensor.changed(sigma=0.01, blur=0.5)
    walker = metropolis.walker_at(metropolis.engine_of(chart, sensor), chart, values)
    draws = metropolis.run(np.random.default_rng(0), walker, single_steps(chart), 1.0, 0.1, 1, 1)
    model_depth(chart, values, camera)
    refined = refined_at(state, chart, values, sensor, *draws.densities[0])
    structure_posterior(np.random.default_rng(0), refined, names_of(state), 1.0, [only_draw(refined)])


def steps_of_chains() -> None:
    """Compile the steps of a chain over a given scene, for their types alone: what they call is not asked for.

    The engine and the contacts are left to the command, which needs them first; what it needs last comes last.
    """
    import numpy as np

    from derender.compilation.cache import address_of
    from derender.document import read_prior_document
    from derender.posterior.compiled.evaluate import stand_all, sweep
    from derender.posterior.compiled.model import Calls, calls_of, chain_of, kernels_of, model_of, objects_below
    from derender.posterior.kernels import mixture
    from derender.posterior.kernels.base import first_tuning
    from derender.posterior.target import default_parts
    from derender.render.raycast.depth import render_depth
    from derender.render.raycast.state import GAUSSIAN, new_state
    from derender.structures.given import targets

    document, rng = read_prior_document("figure-4"), np.random.default_rng(0)
    camera = document.camera
    assert camera is not None
    image = np.full(camera.shape, 0.9)
    target, _ = targets(document, image, camera, 0)[0]
    values = target.space.sample(rng)
    parts = mixture(target.space, default_parts())
    model = model_of(target, lambda kernel, *arguments: 0)
    chain = chain_of(target, False)
    no_places = dict.fromkeys(range(len(parts)), np.empty(0))
    kernels = kernels_of(target.space, parts, first_tuning(target.space, values), frozenset(), no_places,
                         [Calls()] * len(parts), lambda objects: objects_below(target, objects))  # fmt: skip
    engine = new_state(camera, image, target.template.solids(), GAUSSIAN, np.zeros(2), 1.0)
    kept, counts = np.empty((1, len(values) + 2)), np.zeros((len(parts), 2), np.int64)
    address_of(sweep, rng, model, kernels, chain, engine, 0, 1, 1, 1.0, kept, counts)
    calls_of(target, [part for part in parts if not part.type.startswith("relocate")], model, chain)
    address_of(stand_all, model, chain, kept, counts, np.empty((1, 1, 3)))
    render_depth(target.template.solids(), camera)  # for the report
    calls_of(target, parts, model, chain)


PARTS = {"draws": draws_on_a_floor, "steps": steps_of_chains}


if __name__ == "__main__":
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    PARTS[sys.argv[1]]()
