"""What a posterior says of its own image: depth images drawn from it, and how likely the image is, block by block.

Also the best structure's draws as NetCDF-4, with the groups in which ArviZ keeps them; needs h5py (extra `arviz`).
"""

import importlib.util
import io
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.atomic import write_bytes
from derender.camera.intrinsics import Camera
from derender.compilation.threads import in_threads
from derender.errors import DerenderError
from derender.render.likelihoods import drawn_image
from derender.render.raycast.depth import render_depth
from derender.render.raycast.evaluator import DepthEvaluator
from derender.results.posterior import Posterior, StructurePosterior
from derender.sampling.diagnostics import unwrap

LEAST_SIDE, MOST_ACROSS = 8, 20  # pixels of a block's side; blocks across the image's width
LEAST_FILLED = 0.5  # share of a block's pixels that returned a depth: with fewer it is left out
# Draws of which the blocks are scored, and of which images are drawn: at most, and at least of an image with more than
# so many pixels. To score 400 of 640 x 480 pixels took as long as to infer them; 100 do for leave-one-out.
SCORED, DRAWN, LEAST_SCORED, LEAST_DRAWN, PIXELS = 400, 50, 100, 10, 320 * 240
# Nats, standard deviation over draws, by which the sum of the blocks may be off the log likelihood that was drawn
# under, but for a constant: each draw's own blur makes 7; neighbours that share noise thousands: no block counts.
MOST_APART = 15.0


class Blocks(NamedTuple):
    """A posterior's image and what the posterior says of it, by N blocks of pixels.

    Neighbouring pixels share their errors, so a block counts as one observation.

    rows, columns : (N,) int, image coordinates of the blocks' first pixels
    """

    rows: np.ndarray
    columns: np.ndarray
    observed: np.ndarray  # (N,) metres, mean depth of the pixels that returned one
    scored: np.ndarray  # (S,) int, numbers of the draws in each chain that were scored
    log_likelihood: np.ndarray | None  # (chains, S, N), of all pixels of the block; None: see MOST_APART
    drawn: np.ndarray  # (D,) int, numbers of the draws in each chain of which images were drawn
    predicted: np.ndarray  # (chains, D, N) metres, mean depth of the same pixels in an image drawn from the likelihood


def blocks_of(posterior: Posterior, observed: np.ndarray, camera: Camera, rng: np.random.Generator) -> Blocks:
    """Return what the most probable structure's draws say of the image, by blocks.

    observed : (H, W) metres, NaN where nothing returned.
    """
    part = posterior.best_part
    chains, draws = part.log_density.shape
    side = max(LEAST_SIDE, -(-observed.shape[1] // MOST_ACROSS))
    seen = np.isfinite(observed) & (observed > 0)
    count = _sums(seen.astype(float), side)
    kept = count >= LEAST_FILLED * _sums(np.ones(observed.shape), side)
    rows, columns = np.nonzero(kept)

    def means(depth: np.ndarray) -> np.ndarray:
        """Return (N,) mean depths over the pixels that returned one in the image; where that is missing, its own."""
        return (_sums(np.where(seen, np.where(np.isfinite(depth), depth, observed), 0.0), side) / count.clip(1))[kept]

    share = min(1.0, PIXELS / observed.size)
    scored = _spread(draws, max(round(SCORED * share), LEAST_SCORED) // chains)
    drawn = _spread(draws, max(round(DRAWN * share), LEAST_DRAWN) // chains)

    def told(rng: np.random.Generator, chain: int) -> tuple[np.ndarray, np.ndarray]:
        """Return of one chain (S, N) log likelihoods and (D, N) mean depths."""
        scores, evaluator = np.empty((len(scored), len(rows))), None
        for place, draw in enumerate(scored):
            kind, values = likelihood_at(posterior, part, chain, int(draw))
            evaluator = evaluator or DepthEvaluator(camera, observed, kind, values)
            evaluator.log_likelihood(part.graph_at(chain, int(draw), apparent=True).solids(), values)
            scores[place] = _sums(evaluator.per_pixel(), side)[kept]
        images = [means(image_at(posterior, part, chain, int(draw), camera, rng)) for draw in drawn]
        return scores, np.reshape(images, (len(drawn), len(rows)))

    scores, images = map(np.array, zip(*in_threads(rng, [partial(told, chain=k) for k in range(chains)]), strict=True))
    apart = np.std(scores.sum(axis=-1) - part.log_likelihood[:, scored])
    likely = scores if apart < MOST_APART else None
    return Blocks(rows * side, columns * side, means(observed), scored, likely, drawn, images)


def predictive_images(posterior: Posterior, camera: Camera, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return (count, H, W) float64 depth images, metres, drawn from the posterior: structure, draw, then noise.

    NaN is where a drawn image has no return.
    """
    weights = np.array([part.weight for part in posterior.parts])
    found = []
    for number in rng.choice(len(weights), size=count, p=weights / weights.sum()):
        part = posterior.parts[number]
        chain, draw = np.unravel_index(rng.integers(part.log_density.size), part.log_density.shape)
        found.append(image_at(posterior, part, int(chain), int(draw), camera, rng))
    return np.array(found).reshape(count, *camera.shape)


def image_at(
    posterior: Posterior, part: StructurePosterior, chain: int, draw: int, camera: Camera, rng: np.random.Generator
) -> np.ndarray:
    """Return (H, W), an image drawn from the likelihood of one draw, at a camera's pixels."""
    kind, values = likelihood_at(posterior, part, chain, draw)
    clean, _ = render_depth(part.graph_at(chain, draw, apparent=True).solids(), camera)
    return drawn_image(kind, rng, clean, values, posterior.meta["likelihood"].get("drawn"))


def likelihood_at(
    posterior: Posterior, part: StructurePosterior, chain: int, draw: int
) -> tuple[str, Mapping[str, float]]:
    """Return the type of the likelihood and its numbers in one draw.

    Raises DerenderError : the posterior does not say under which likelihood it came about.
    """
    told: dict[str, Any] = dict(posterior.meta.get("likelihood") or {})
    if "type" not in told:
        raise DerenderError("the posterior does not say what its likelihood was", remedy="infer again")
    kind = told.pop("type")
    told.pop("drawn", None)  # of images alone
    return kind, {name: float(value) for name, value in told.items()} | part.likelihood_at(chain, draw)


def _spread(draws: int, most: int) -> np.ndarray:
    """Return the numbers of at most so many draws, evenly spread."""
    return np.unique(np.linspace(0, draws - 1, min(draws, max(most, 1))).astype(int))


def _sums(values: np.ndarray, side: int) -> np.ndarray:
    """Return the sums of an image's blocks; those at the right and lower edge may be smaller."""
    starts: Sequence[np.ndarray] = [np.arange(0, length, side) for length in values.shape]
    return np.add.reduceat(np.add.reduceat(values, starts[0], axis=0), starts[1], axis=1)


# Nats between one draw and the next, added to what a block's log likelihood is: ArviZ 1 refuses `loo` where the tail of
# a block's draws is one number, as it is where nothing but a known floor is seen, and where chains stood still.
TIE = 1e-9


def write_netcdf(path: str | Path, posterior: Posterior, blocks: Blocks | None = None) -> bool:
    """Write the groups `posterior` and `sample_stats`; return False where `can_be_read` does.

    With `blocks` also `observed_data`, `log_likelihood` and `posterior_predictive` (each `depth` over the dimension
    `block`; `constant_data` says where the blocks lie), so that `arviz.loo` and `arviz.plot_ppc` have what they need;
    no `log_likelihood` where it cannot be told by blocks. Attributes say of which structure, and how probable it is.

    Written with h5py alone, as h5netcdf lays it out: ArviZ takes longer to import than most inferences, and h5netcdf
    longer to write. `arviz.from_netcdf` reads it. In memory first: where a disk is full, HDF5 prints tracebacks.
    """
    if not can_be_read():
        return False
    import h5py

    part = posterior.best_part
    chain, draw = (np.arange(length) for length in part.log_density.shape)
    told = enumerate(zip(part.addresses, part.periods, strict=True))  # angles on one turn, as the table has them
    columns = {address: unwrap(part.values[:, :, i], period) for i, (address, period) in told}
    stats = {"lp": part.log_density, "log_prior": part.log_prior, "log_likelihood": part.log_likelihood}
    walk = {"chain": chain, "draw": draw}
    groups = {"posterior": (walk, columns), "sample_stats": (walk, stats)}
    if blocks is not None and len(blocks.observed):  # so few pixels may have returned that no block counts
        number = {"block": np.arange(len(blocks.observed))}
        where = {"row": blocks.rows, "column": blocks.columns}
        groups |= {"observed_data": (number, {"depth": blocks.observed}), "constant_data": (number, where)}
        if (scored := blocks.log_likelihood) is not None:
            apart = TIE * np.arange(scored[..., 0].size).reshape(*scored.shape[:2], 1)
            over = {"chain": chain, "draw": blocks.scored} | number
            groups["log_likelihood"] = (over, {"depth": scored + apart})
        over = {"chain": chain, "draw": blocks.drawn} | number
        groups["posterior_predictive"] = (over, {"depth": blocks.predicted})
    whole = io.BytesIO()
    with h5py.File(whole, "w", track_order=True) as file:
        file.attrs["_NCProperties"] = f"version=2,h5py={h5py.__version__}"
        file.attrs["creation_library"] = "derender"
        identity = count()  # of a dimension: its own in the whole file, or readers take another group's for it
        for name, (dimensions, variables) in groups.items():
            group = file.create_group(name, track_order=True)
            _write_group(group, dimensions, variables, identity)
            for key in ("version", "command"):
                group.attrs[key] = str(getattr(posterior, key))
            group.attrs["seed"] = int(posterior.seed or 0)
            group.attrs["structure"] = ", ".join(part.graph.names)
            group.attrs["probability"] = float(part.weight)  # of this structure: what is drawn is given that
            group.attrs["units"] = "metres, radians"
    write_bytes(path, whole.getvalue())
    return True


def can_be_read() -> bool:
    """Return whether what writes the file is installed, and what could read it."""
    installed = {name for name in ("h5py", "h5netcdf", "netCDF4") if importlib.util.find_spec(name) is not None}
    return "h5py" in installed and len(installed) > 1


def _write_group(
    group: Any, dimensions: Mapping[str, np.ndarray], variables: Mapping[str, np.ndarray], identity: Iterator[int]
) -> None:
    """Write variables over all dimensions, and these with their coordinates as the scales that NetCDF-4 asks for."""
    scales = []
    for dimension, coordinates in dimensions.items():
        scale = group.create_dataset(dimension, data=coordinates)
        scale.make_scale(dimension)
        scale.attrs["_Netcdf4Dimid"] = np.int32(next(identity))
        scales.append(scale)
    for label, values in variables.items():
        dataset = group.create_dataset(label, data=np.ascontiguousarray(values))
        for axis, scale in enumerate(scales):
            dataset.dims[axis].attach_scale(scale)
