"""The best structure's draws as NetCDF-4, with the groups in which ArviZ keeps them; needs h5netcdf (extra `arviz`)."""

from pathlib import Path

import numpy as np

from derender.atomic import atomic_path
from derender.inference.posterior import Posterior


def write_netcdf(path: str | Path, posterior: Posterior) -> bool:
    """Write the groups `posterior` and `sample_stats`; return False where h5netcdf is not installed.

    Written without ArviZ, whose import alone takes longer than most inferences; `arviz.from_netcdf` reads it.
    """
    try:
        import h5netcdf
    except ImportError:
        return False
    part = posterior.best_part
    chains, draws, _ = part.values.shape
    columns = {address: part.values[:, :, i] for i, address in enumerate(part.addresses)}
    stats = {"lp": part.log_density, "log_prior": part.log_prior, "log_likelihood": part.log_likelihood}
    with atomic_path(path) as temporary, h5netcdf.File(temporary, "w") as file:
        file.attrs["creation_library"] = "derender"
        for name, variables in (("posterior", columns), ("sample_stats", stats)):
            group = file.create_group(name)
            group.dimensions = {"chain": chains, "draw": draws}
            group.create_variable("chain", ("chain",), data=np.arange(chains))
            group.create_variable("draw", ("draw",), data=np.arange(draws))
            for label, values in variables.items():
                group.create_variable(label, ("chain", "draw"), data=np.ascontiguousarray(values))
            for key in ("version", "command"):
                group.attrs[key] = str(getattr(posterior, key))
            group.attrs["seed"] = int(posterior.seed or 0)
    return True
