"""The best structure's draws as NetCDF-4, with the groups in which ArviZ keeps them; needs h5py (extra `arviz`)."""

import importlib.util
from collections.abc import Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from derender.atomic import atomic_path
from derender.results.posterior import Posterior
from derender.results.predictive import Blocks

# Nats between one draw and the next, added to what a block's log likelihood is: ArviZ 1 refuses `loo` where the tail of
# a block's draws is one number, as it is where nothing but a known floor is seen, and where chains stood still.
TIE = 1e-9


def write_netcdf(path: str | Path, posterior: Posterior, blocks: Blocks | None = None) -> bool:
    """Write the groups `posterior` and `sample_stats`; return False where `can_be_read` does.

    With `blocks` also `observed_data`, `log_likelihood` and `posterior_predictive` (each `depth` over the dimension
    `block`; `constant_data` says where the blocks lie), so that `arviz.loo` and `arviz.plot_ppc` have what they need.

    Written with h5py alone, as h5netcdf lays it out: ArviZ takes longer to import than most inferences, and h5netcdf
    longer to write. `arviz.from_netcdf` reads it.
    """
    if not can_be_read():
        return False
    import h5py

    part = posterior.best_part
    chain, draw = (np.arange(length) for length in part.log_density.shape)
    columns = {address: part.values[:, :, i] for i, address in enumerate(part.addresses)}
    stats = {"lp": part.log_density, "log_prior": part.log_prior, "log_likelihood": part.log_likelihood}
    walk = {"chain": chain, "draw": draw}
    groups = {"posterior": (walk, columns), "sample_stats": (walk, stats)}
    if blocks is not None and len(blocks.observed):  # so few pixels may have returned that no block counts
        number = {"block": np.arange(len(blocks.observed))}
        where = {"row": blocks.rows, "column": blocks.columns}
        scored = blocks.log_likelihood
        apart = TIE * np.arange(scored[..., 0].size).reshape(*scored.shape[:2], 1)
        groups |= {
            "observed_data": (number, {"depth": blocks.observed}),
            "constant_data": (number, where),
            "log_likelihood": ({"chain": chain, "draw": blocks.scored} | number, {"depth": scored + apart}),
            "posterior_predictive": ({"chain": chain, "draw": blocks.drawn} | number, {"depth": blocks.predicted}),
        }
    with atomic_path(path) as temporary, h5py.File(temporary, "w", track_order=True) as file:
        file.attrs["_NCProperties"] = f"version=2,h5py={h5py.__version__}"
        file.attrs["creation_library"] = "derender"
        identity = count()  # of a dimension: its own in the whole file, or readers take another group's for it
        for name, (dimensions, variables) in groups.items():
            group = file.create_group(name, track_order=True)
            _write_group(group, dimensions, variables, identity)
            for key in ("version", "command"):
                group.attrs[key] = str(getattr(posterior, key))
            group.attrs["seed"] = int(posterior.seed or 0)
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
