"""The best structure's draws as NetCDF-4, with the groups in which ArviZ keeps them; needs h5netcdf (extra `arviz`)."""

import importlib.util
from pathlib import Path

import numpy as np

from derender.atomic import atomic_path
from derender.results.posterior import Posterior


def write_netcdf(path: str | Path, posterior: Posterior) -> bool:
    """Write the groups `posterior` and `sample_stats`; return False where h5netcdf is not installed.

    Written with h5py alone, as h5netcdf lays it out: ArviZ takes longer to import than most inferences, and h5netcdf
    longer to write. `arviz.from_netcdf` reads it.
    """
    if importlib.util.find_spec("h5netcdf") is None:  # nothing here could read it
        return False
    import h5py

    part = posterior.best_part
    columns = {address: part.values[:, :, i] for i, address in enumerate(part.addresses)}
    stats = {"lp": part.log_density, "log_prior": part.log_prior, "log_likelihood": part.log_likelihood}
    with atomic_path(path) as temporary, h5py.File(temporary, "w", track_order=True) as file:
        file.attrs["_NCProperties"] = f"version=2,h5py={h5py.__version__}"
        file.attrs["creation_library"] = "derender"
        for name, variables in (("posterior", columns), ("sample_stats", stats)):
            group = file.create_group(name, track_order=True)
            _write_group(group, variables, part.log_density.shape)
            for key in ("version", "command"):
                group.attrs[key] = str(getattr(posterior, key))
            group.attrs["seed"] = int(posterior.seed or 0)
    return True


def _write_group(group, variables, shape) -> None:
    """Write variables over (chain, draw), and these two dimensions as the scales that NetCDF-4 asks for."""
    scales = []
    for number, (dimension, length) in enumerate(zip(("chain", "draw"), shape, strict=True)):
        scale = group.create_dataset(dimension, data=np.arange(length))
        scale.make_scale(dimension)
        scale.attrs["_Netcdf4Dimid"] = np.int32(number)
        scales.append(scale)
    for label, values in variables.items():
        dataset = group.create_dataset(label, data=np.ascontiguousarray(values))
        for axis, scale in enumerate(scales):
            dataset.dims[axis].attach_scale(scale)
