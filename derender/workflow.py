"""What `derender infer` does: read the image, have it inferred, have the folder written."""

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from derender.atomic import make_folder
from derender.camera.depth_file import read_depth
from derender.compilation.threads import import_in_background
from derender.document import LikelihoodPrior, prior_as_seen_from, read_prior_document
from derender.errors import DerenderError, at_fault
from derender.posterior.settings import read_settings
from derender.registry import suggest
from derender.report.result_folder import Outcome, write_results
from derender.results.posterior import Posterior
from derender.structures.draws.scene_density import BARE_IMAGE
from derender.structures.precompile import precompile

NEARBY = (0.08, 8.0)  # metres: what depth cameras see lies between
WRITERS = ("derender.report.html", "derender.results.netcdf", "h5py")  # modules that only the files need
SWITCHES = {"may_overlap": "--allow-interpenetration", "may_float": "--allow-floating"}


def infer_to_folder(
    image: str,
    prior: str | None,
    output: str | None,
    camera: str | None = None,
    depth_scale: float | None = None,
    method: str = "auto",
    gradient: str = "exact",
    chains: int | None = None,
    draws: int | None = None,
    warmup: int | None = None,
    jobs: int = 1,
    resume: bool = False,
    seed: int = 0,
    strict: bool = False,
    command: str = "derender infer",
    progress: Callable[[float, str], None] | None = None,
    say: Callable[[str], None] = lambda line: None,
    warn: Callable[[str], None] = lambda line: None,
    **found: Any,
) -> Outcome:
    """Infer and write; the arguments are those of the command, `found` those that say what is known of a bare image.

    Raises
    ------
    DerenderError : whatever is wrong with the image, the camera, the prior or the folder.
    """
    started = time.monotonic()
    document = read_prior_document(prior) if prior is not None else None
    seen = read_depth(image, camera, depth_scale)
    if seen.camera_is_guess and document is not None and document.camera is not None:
        if document.camera.shape == seen.depth.shape:
            seen = seen._replace(camera=document.camera, camera_is_guess=False)
    if seen.camera_is_guess:
        warn(f"no camera is given: taking {seen.camera.field_of_view:.0f} degrees horizontal field of view")
    if not np.any(np.isfinite(seen.depth) & (seen.depth > 0)):
        raise DerenderError("the image has no pixel with a depth", image, "give an image that shows something")
    middle = float(np.median(seen.depth[np.isfinite(seen.depth) & (seen.depth > 0)]))
    if not NEARBY[0] < middle < NEARBY[1]:
        warn(f"the depths lie about {middle:.3g} m away: if that is wrong, give the unit, as in --depth-scale 0.1")
    given = document is not None and has_objects(document)
    if gradient != "exact" and (method != "map" or not given):
        warn("--gradient says nothing here: it is for --method map with a scene given by --scene")
    if given:
        for key, value in found.items():
            if value:
                option = SWITCHES.get(key, "--" + key.replace("_", "-"))
                raise DerenderError(f"{option} is for images without a scene", prior, f"leave out {option} or --scene")
    folder = make_folder(output or f"{Path(image).stem if image != '-' else 'scene'}_inferred")
    if resume and (given or method in ("mcmc", "smc")) and not (folder / "checkpoint").exists():
        say(f"nothing was interrupted in {folder}: beginning anew")
    made = {"seed": seed, "command": command}
    if prior != "-":
        made["prior"] = BARE_IMAGE if prior is None else prior_as_seen_from(prior, folder)
    try:
        with at_fault(prior if given else image):
            return _infer(folder, document, seen, image, method, gradient, found, chains, draws, warmup, jobs,
                          resume, made, progress, warn, started)  # fmt: skip
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) and (folder / "checkpoint").exists():
            say(f"the work so far is in {folder / 'checkpoint'}: the same command with --resume goes on")
        with contextlib.suppress(OSError):
            folder.rmdir()  # nothing was written: leave nothing
        raise


def _infer(folder, document, seen, image, method, gradient, found, chains, draws, warmup, jobs, resume,
           made, progress, warn, started) -> Outcome:  # fmt: skip
    """Infer by what is given, and write."""
    interrupted, lost = False, {}
    seed, command = made["seed"], made["command"]
    precompile("steps" if document is not None and has_objects(document) else "draws")
    if document is not None and has_objects(document):
        from derender.structures.given import SMC_PARTICLES, infer_scene

        for option, number in (("--draws", draws), ("--warmup", warmup)):
            if method == "smc" and number is not None:
                warn(f"{option} says nothing here: each population of --method smc has {SMC_PARTICLES} particles")
        import_in_background(*WRITERS)
        likelihood = document.likelihood or LikelihoodPrior()
        settings = read_settings(document.inference)
        given = {"chains": chains, "draws": draws, "warmup": warmup}
        settings = settings._replace(**{key: value for key, value in given.items() if value is not None})
        result = infer_scene(
            document,
            seen.depth,
            seen.camera,
            settings,
            method,
            seed,
            jobs,
            folder,
            resume,
            progress,
            command,
            gradient,
            warn,
        )
        posterior, interrupted, lost = result
    else:
        for option, present in (("--resume", resume), ("--warmup", warmup is not None)):
            if present and method in ("auto", "map"):
                warn(f"{option} says nothing here: it is for --method mcmc or smc, or for a scene given with --scene")
        run = {"folder": folder, "resume": resume, "jobs": jobs, "warmup": warmup}
        posterior = _structure(seen, document, method, found, chains, draws, seed, _importing(progress), run)
        interrupted, lost = bool(posterior.meta.get("interrupted")), posterior.meta.get("lost_chains", {})
        if posterior.meta.get("backdrop"):
            share = f"{posterior.meta['backdrop']:.0%} of the pixels lie on a plane or beyond"
            warn(f"{share}: taken as background; with --floor auto solids stand on it")
        fitted = dict(posterior.meta["likelihood"])
        likelihood = LikelihoodPrior(fitted.pop("type"), fitted)
    meta = {
        **posterior.meta,
        "image": str(image),
        "method": method,
        "camera": seen.camera.to_dict(),
        "camera_guessed": seen.camera_is_guess,
        "interrupted": interrupted,
        "lost_chains": sorted(lost),
    }
    posterior = replace(posterior, seed=seed, command=command, meta=meta)
    for number, why in lost.items():
        warn(f"chain {number} was lost: {why.strip().splitlines()[-1]}")
    return write_results(folder, posterior, seen, likelihood, made, len(lost), time.monotonic() - started)


def _importing(progress):
    """Return `progress` that also begins to import what the files need, when the search gives way to long walks."""

    def told(share, message):
        if share > 0.0:
            import_in_background(*WRITERS)
        if progress:
            progress(share, message)

    return told


def has_objects(document) -> bool:
    """Return whether the document names its objects."""
    from derender.scene.priors.tree import TreePrior

    return isinstance(document.prior, TreePrior)


def _structure(seen, document, method, found, chains, draws, seed, progress, run) -> Posterior:
    """Infer what there is from the image alone; `found` holds the options that say what is known of it.

    run : folder, resume, jobs and warmup, which chains over structures heed.
    """
    from derender.detection.solids.image import KINDS
    from derender.structures.infer import infer_structure
    from derender.structures.known.library import read_library

    chosen = {"method": method, "seed": seed, "floor": found["floor"], "others": not found["only_known"],
              "may_overlap": found["may_overlap"], "may_float": found["may_float"]}  # fmt: skip
    if found["shapes"] is not None:
        chosen["shapes"] = [name.strip() for name in found["shapes"].split(",")]
        for name in chosen["shapes"]:
            if name not in KINDS:
                raise DerenderError(f"{name!r} is no shape to look for", "--shapes", suggest(name, sorted(KINDS)))
    if found["known"] is not None:
        chosen["known"] = read_library(found["known"])
    elif found["only_known"]:
        raise DerenderError("nothing is known", "--only-known", "give a library with --known FILE")
    for key, value in (("max_objects", found["max_objects"]), ("chains", chains), ("draws", draws)):
        if value is not None:
            chosen[key] = value
    if method in ("mcmc", "smc") and found["known"] is not None:
        raise DerenderError(f"--method {method} does not know of libraries", "--known", "leave --method out")
    if method in ("mcmc", "smc") and document is not None:
        from derender.structures.jumps.run import infer_by_jumps

        chosen |= run
        return infer_by_jumps(seen.depth, seen.camera, chosen, document, np.random.default_rng(seed), progress)
    if document is not None:
        chosen["prior"], chosen["likelihood"] = document.prior, document.likelihood
    if method in ("mcmc", "smc"):
        chosen |= run
    return infer_structure(seen.depth, seen.camera, chosen, np.random.default_rng(seed), progress)
