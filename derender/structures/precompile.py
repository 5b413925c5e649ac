"""Kernels compiled by a second process, on a scene of a few pixels, while the first one compiles others: half the wait
at the first use. They reach the command through the cache (compilation/cache.py), which lets no two compile the same
one."""

import functools
import os
import subprocess
import sys
import threading

from derender.compilation.cache import helpers
from derender.compilation.threads import processors

WIDTH, HEIGHT = 32, 24  # pixels of the images that are only there to be compiled for


def precompile(part: str) -> None:
    """Have one of PARTS compiled beside this process, should it compile anything; with one processor, not."""
    if processors() > 1:
        helpers.append(functools.partial(_start, part))


@functools.cache  # it keeps the pipe to the other process open as long as this one lives
def _start(part: str) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-P", "-m", "derender.structures.precompile", part], stdin=subprocess.PIPE,
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
    from derender.structures.draws.refined import near_evidence, only_draw, over_blur, refined_at, structure_posterior
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
    near_evidence(refined)
    over_blur(np.random.default_rng(0), refined, (), values[None])


def engine_of_a_scene() -> None:
    """Compile the engine on which chains over a given scene walk."""
    import numpy as np

    from derender.camera.intrinsics import Camera
    from derender.render.raycast.depth import render_depth
    from derender.render.raycast.engine import for_steps, new_engine
    from derender.render.raycast.state import GAUSSIAN
    from derender.scene.pose import translation
    from derender.scene.solids import BOX, PLANE, Solids

    camera, poses = Camera.from_field_of_view(WIDTH, HEIGHT), np.array([translation(0.0, 0.0, 0.8)] * 2)
    solids = Solids(np.array([PLANE, BOX], np.int32), poses, np.full((2, 3), 0.1), np.full(2, -1, np.int32))
    for_steps(new_engine(camera, np.full(camera.shape, 0.8), solids, GAUSSIAN, np.zeros(2), 0.5))
    render_depth(solids, camera)


PARTS = {"draws": draws_on_a_floor, "engine": engine_of_a_scene}

if __name__ == "__main__":
    threading.Thread(target=_leave_with_parent, daemon=True).start()
    PARTS[sys.argv[1]]()
