"""Measure the exact derivative of the antialiased image against differences of images. One table on stdout.

A plane and four solids of one shape (meshes: tori of 5,120 triangles) at 64 x 64, one of them moving in a random way
(shift, turn and growth), blur of one pixel. Errors are shares of the norm of what is compared with:
* `rays`: central differences of images of 16 x 16 rays a pixel, the mean over 64 places of their grid within a ray's
  distance from the next; `rays itself`: half the difference of two halves of the places, what is known of that mean;
* `one grid`: the same of the grid in its usual place alone, with the step that suits it best. That is mostly its own
  error: in a short step an edge nearly along a row of rays meets none of them or all, and in a long one solids that
  touch leave each other or enter;
* `lines`: differences of an image that is integrated exactly along 64 lines a pixel (`exact_rows`), which shares
  nothing with ours but the solids; `lines itself`: those of 32 lines against those of 64. Not of meshes;
* `own`: differences of the antialiased image itself, the smallest of four steps (where a curved outline gets one chord
  more, a step may show the change): is the derivative that of the image?
* `image`: the antialiased image's own error against 64 x 64 rays, as a share of that of one ray a pixel.

The last lines say what derivatives by all numbers of a chain of ten cubes cost, in forward renders (image, blur and
comparison) of the same chain, all of it moved each time.
"""

import argparse
import sys
import time

import numpy as np

from derender.camera.intrinsics import Camera
from derender.cli import status_of
from derender.evaluation.gradient_check import BACKGROUND, BLUR, SHAPES, errors
from derender.posterior.map import MapProblem
from derender.render.gradient import SmoothLikelihood
from derender.render.raycast.depth import render_depth
from derender.scene.graph import SceneGraph
from derender.scene.pose import rotation_x, translation
from derender.scene.vertex import Contact, Vertex


def chain_costs(width: int, height: int, repeats: int = 200) -> tuple[float, float, float]:
    """Return seconds of a forward render of ten cubes on each other, of it with the gradient, and with the Hessian."""
    root = translation(0, 0.3, 1.6) @ rotation_x(np.pi / 2 + 0.4)
    vertices = [Vertex("floor", "plane", {}, "root", Contact("6dof"))]
    for n in range(10):
        place = {"theta": 0.5 * n, "u": 0.45, "v": 0.55} if n else {"theta": 0.5, "x": 0.0, "y": 0.0}
        contact = Contact("face-to-face", "+z", "-z", place)
        vertices.append(Vertex(f"cube{n}", "cube", {"side": 0.1 - 0.004 * n}, vertices[-1].name, contact))
    graph = SceneGraph(root, tuple(vertices))
    addresses = [address for address in graph.numbers() if address.startswith("cube")]
    camera = Camera.from_field_of_view(width, height)
    depth, _ = render_depth(graph.solids(), camera, background=BACKGROUND)
    problem = MapProblem(graph, addresses, camera, depth, blur=BLUR)
    likelihood = SmoothLikelihood(camera, depth, graph.solids().kind, blur_sigma=BLUR, background=BACKGROUND)
    lower = np.flatnonzero([address.startswith("cube0.contact.x") for address in addresses])
    places = [problem.values, problem.values + 1e-3 * np.isin(np.arange(len(addresses)), lower)]
    scenes = [problem.scene(values).solids() for values in places]

    def median(call, each):
        call(each[0])
        times = []
        for n in range(repeats):
            begin = time.perf_counter()
            call(each[(n + 1) % 2])
            times.append(time.perf_counter() - begin)
        return float(np.median(times))

    cubes = np.arange(len(graph.vertices)) > 0
    return (median(likelihood.log_likelihood, scenes),
            median(lambda solids: likelihood.gradient(solids, cubes), scenes),
            median(problem.laplace, places))  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("shapes", nargs="*", metavar="SHAPE", help=f"some of {', '.join(SHAPES)}: only those")
    parser.add_argument("--scenes", type=int, default=24, help="of each shape")
    parser.add_argument("--with-rays", type=int, default=24, help="so many of them against rays and lines")
    options = parser.parse_args()
    print(f"{'':12s}{'':12s}{'median':>9s}{'95 %':>9s}{'worst':>9s}{'scenes':>9s}")
    for shape in options.shapes or SHAPES:
        rows: dict[str, list[float]] = {}
        for seed in range(options.scenes):
            for name, value in errors(SHAPES[shape], seed, seed < options.with_rays).items():
                rows.setdefault(name, []).append(value)
        for name, values in rows.items():
            low, high = np.quantile(values, [0.5, 0.95])
            print(f"{shape:12s}{name:12s}{low:9.2%}{high:9.2%}{max(values):9.2%}{len(values):9d}", flush=True)
    for size in ((64, 64), (160, 120)):
        forward, gradient, hessian = chain_costs(*size)
        print(f"ten cubes at {size[0]} x {size[1]}: forward {1e6 * forward:.0f} us, with the gradient by all numbers "
              f"{gradient / forward:.2f} times that, with the Hessian too {hessian / forward:.2f} times")  # fmt: skip


if __name__ == "__main__":
    sys.exit(status_of(main))
