"""The story of `derender infer` on one page: read the image, ask what is known, infer, write the folder."""

import contextlib
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.atomic import ROOM, make_folder
from derender.camera.depth_file import DepthImage, Reading
from derender.camera.intrinsics import Camera
from derender.camera.poses import poses_of_camera_file, read_poses, turned_pose
from derender.compilation.threads import import_in_background, interruptible
from derender.detection.resampled import Enlargement, as_made, smaller_image_of
from derender.document import Document, LikelihoodPrior, prior_as_seen_from, read_prior_document
from derender.errors import DerenderError, Idle, at_fault, idle_lines
from derender.report.result_folder import Outcome, write_results
from derender.results.posterior import Posterior
from derender.scene.pose import inverse
from derender.structures.draws.numbers import BARE_IMAGE
from derender.structures.options import Frame, Options, names_objects
from derender.structures.precompile import precompile

NEARBY = (0.08, 8.0)  # metres: what depth cameras see lies between
WRITERS = ("derender.report.html", "derender.results.predictive", "h5py")  # modules that only the files need
# Of a scene whose objects are given nothing remains to be said of what there is.
FOR_BARE_IMAGES = ("shapes", "max_objects", "floor", "known", "only_known", "may_overlap", "may_float", "budget")

NO_DRAWS = "--method map and --quick find the best scene, and draw nothing"
WALKS = "it is for --method mcmc, or for a scene given with --scene"
IDLE = (  # beside the method, and whether the objects are given
    Idle(("gradient",), lambda of: not (of["method"] == "map" and of["given"]), "it is for --method map with --scene"),
    Idle(("chains",), lambda of: of["method"] == "map" and not of["given"], NO_DRAWS),
    Idle(("draws", "warmup"), lambda of: of["method"] == "map", NO_DRAWS),
    Idle(("draws", "warmup"), lambda of: of["given"] and of["method"] == "smc", "populations have a fixed size"),
    Idle(("warmup", "resume"), lambda of: not of["given"] and of["method"] != "mcmc", WALKS),
    Idle(("budget",), lambda of: not of["given"] and of["method"] != "auto", "it is for --method auto"),
    Idle(("shapes", "may_overlap", "may_float"), lambda of: not of["given"] and of["method"] == "mcmc",
         "it is the prior that says what --method mcmc may visit"),
)  # fmt: skip

AS_IT_IS = Reading()

IN_PIXELS = ("blur", "reach", "reach_down")  # of a likelihood's numbers

Say = Callable[[str], None]
Progress = Callable[[float, str], None]


def silent(line: str) -> None:
    """Say nothing."""


def infer_to_folder(
    image: str,
    options: Options,
    prior: str | None = None,
    output: str | None = None,
    reading: Reading = AS_IT_IS,
    command: str = "derender infer",
    page: bool = True,
    progress: Progress | None = None,
    say: Say = silent,
    warn: Say = silent,
    frames: Sequence[str] = (),
    poses: str | None = None,
) -> Outcome:
    """Infer the scene behind a depth image and write the folder of results.

    image : file of the depth image; `-` is stdin. prior : scene file or built-in prior, or None: a bare image.
    output : folder; None: the image's name with _inferred.
    reading : how the image is read: with which camera, unit, turn and confidence.
    command : recorded in what is written. page : whether report.html is written, which can be made later.
    progress : called with (fraction done, message). say, warn : called with a line for a person.
    frames : files of further images of the same scene, which stands still; poses : file of where all cameras stood
        (see `read_poses`), None: as the camera file says, or else they are found.

    Raises DerenderError : whatever is wrong with the images, the camera, the poses, the prior or the folder.
    """
    started = time.monotonic()
    if frames:
        options = replace(options, frames=read_frames([image, *frames], poses, reading))
    folder = Path(output or f"{Path(image).stem if image != '-' else 'scene'}_inferred")
    request = ask(image, options, prior, folder, reading, command, warn)
    return answer(request, make_folder(folder, ROOM), page, started, progress, say, warn)


class Request(NamedTuple):
    """All that an inference needs, read and checked: it can go to another machine."""

    image: str  # the image's name
    seen: DepthImage  # the image
    document: Document | None  # of a prior or scene, or None
    where: str | None  # whose fault a fault is
    options: Options  # see `infer_to_folder`
    made: dict[str, Any]  # seed, command and prior, recorded in what is written
    home: Path  # the results' folder, absolute: files are named as seen from there


def ask(
    image: str,
    options: Options,
    prior: str | None,
    folder: Path,
    reading: Reading = AS_IT_IS,
    command: str = "derender infer",
    warn: Say = silent,
) -> Request:
    """Read all files that an inference needs and return the Request; the arguments are those of `infer_to_folder`."""
    document, options = asked_of_any(options, prior, warn)
    seen = look_at(reading.read(image, None if document is None else document.camera), document, image, warn)
    made: dict[str, Any] = {"seed": options.seed, "command": command}
    if prior != "-":
        made["prior"] = BARE_IMAGE if prior is None else prior_as_seen_from(prior, folder)
    where = prior if names_objects(document) else image
    return Request(str(image), seen, document, where, options, made, Path(os.path.realpath(folder)))


def asked_of_any(options: Options, prior: str | None, warn: Say = silent) -> tuple[Document | None, Options]:
    """Read what is asked of any image, whichever it is: the prior's document and the options, their library read."""
    document = read_prior_document(prior) if prior is not None else None
    check_request(options, document, prior, warn)
    return document, with_library(options)


def with_library(options: Options) -> Options:
    """Return the options with the library of known objects read, where they name its file."""
    if not isinstance(options.known, str | Path):
        return options
    from derender.structures.known.library import read_library

    return replace(options, known=read_library(options.known))


def read_frames(images: Sequence[str], poses: str | None, reading: Reading) -> tuple[Frame, ...]:
    """Return the Frames of all images but the first, from where the cameras stood."""
    known = read_poses(poses, images) if poses is not None else poses_of_camera_file(reading.camera, images)
    frames = []
    for k, name in enumerate(images[1:], start=1):
        seen, into = reading.read(name), None
        if known is not None:
            first, own = (turned_pose(pose, reading.rotate) for pose in (known[0], known[k]))
            into = inverse(own) @ first
        frames.append(Frame(*as_made(seen.depth, seen.camera), into, name))
    return tuple(frames)


def answer(
    request: Request,
    folder: Path,
    page: bool = True,
    started: float | None = None,
    progress: Progress | None = None,
    say: Say = silent,
    warn: Say = silent,
) -> Outcome:
    """Infer what was asked and write it into a folder; started : when, of the monotonic clock, where that is told."""
    options, began = request.options, time.monotonic() if started is None else started
    keeps = names_objects(request.document) or options.method == "mcmc"  # checkpoints
    if options.resume and keeps and not (folder / "checkpoint").exists():
        say(f"nothing was interrupted in {folder}: beginning anew")
    command = request.made["command"]
    try:
        with at_fault(request.where):
            own = replace(options, folder=folder)
            posterior, likelihood = infer_image(request.seen, request.document, own, progress, warn, command)
            posterior = replace(posterior, command=command, meta={**posterior.meta, "image": request.image})
            with interruptible() as stop:  # what was inferred is written, whoever loses patience now
                outcome = write_results(
                    folder, posterior, request.seen, likelihood, request.made,
                    time.monotonic() - began, page, started is not None, request.home,
                )  # fmt: skip
            return replace(outcome, interrupted=outcome.interrupted or stop.is_set())
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) and (folder / "checkpoint").exists():
            say(f"the work so far is in {folder / 'checkpoint'}: the same command with --resume goes on")
        with contextlib.suppress(OSError):
            folder.rmdir()  # nothing was written: leave nothing
        raise


def look_at(seen: DepthImage, document: Document | None, where: object, warn: Say = silent) -> DepthImage:
    """Return the image with the camera of the document where it has none of its own; warn of what looks wrong."""
    if seen.camera_is_guess and document is not None and document.camera is not None:
        if document.camera.shape == seen.depth.shape:
            seen = seen._replace(camera=document.camera, camera_is_guess=False)
    if seen.camera_is_guess:
        warn(f"--camera is not given: taking {seen.camera.field_of_view:.0f} degrees horizontal field of view")
    known = seen.depth[np.isfinite(seen.depth) & (seen.depth > 0)]
    if not known.size:
        raise DerenderError("the image has no pixel with a depth", where, "give an image that shows something")
    middle = float(np.median(known))
    if not NEARBY[0] < middle < NEARBY[1]:
        warn(f"the depths lie about {middle:.3g} m away: if that is wrong, give the unit, as in --depth-scale 0.1")
    return seen


def spelt(name: str) -> str:
    """Return how an option of this name is written on the command line."""
    switches = {"may_overlap": "allow-interpenetration", "may_float": "allow-floating"}
    return "--" + switches.get(name, name).replace("_", "-")


def check_request(options: Options, document: Document | None, prior: object, warn: Say) -> None:
    """Refuse, or warn of, options that say nothing about what is asked."""
    given, method = names_objects(document), options.method
    asked, usual = vars(options), vars(Options())
    told = {name: spelt(name) for rule in IDLE for name in rule.names if asked[name] != usual[name]}
    for line in idle_lines(IDLE, told, {"method": method, "given": given}):
        warn(line)
    if given:
        if options.frames:
            raise DerenderError("--together is for images without a scene", prior, "leave out --together or --scene")
        for key in FOR_BARE_IMAGES:
            if asked[key] is not usual[key]:  # an array is neither true nor false
                option = spelt(key)
                raise DerenderError(f"{option} is for images without a scene", prior, f"leave out {option} or --scene")
        return
    if method == "smc":
        raise DerenderError("--method smc is for objects that are given", prior, "add --scene, or take --method mcmc")
    if options.frames:
        for option, present in (("--known", options.known is not None), ("--floor", options.floor is not None),
                                ("--method mcmc", method == "mcmc")):  # fmt: skip
            if present:
                raise DerenderError(f"{option} is for one image", "--together", f"leave out {option} or --together")
    if method == "mcmc" and options.known is not None:
        raise DerenderError("--method mcmc does not know of libraries", "--known", "leave --method out")


def infer_image(
    seen: DepthImage,
    document: Document | None,
    options: Options,
    progress: Progress | None = None,
    warn: Say = silent,
    command: str = "",
) -> tuple[Posterior, LikelihoodPrior]:
    """Infer what an image shows: the numbers of the objects that a document names, or from the image what there is.

    Returns the posterior, and the likelihood under which it explains the image. The one state outside is the folder of
    checkpoints, where `options` name one.
    """
    smaller = smaller_image_of(seen.depth)
    if smaller is None:
        return _inferred(seen, document, options, progress, warn, command)
    warn(smaller.told())
    own = seen._replace(depth=smaller.reduced(seen.depth), camera=smaller.camera(seen.camera))
    posterior, likelihood = _inferred(own, document, options, progress, warn, command)
    fixed = {**likelihood.values, **in_its_pixels(likelihood.fixed, smaller)}
    return as_enlarged(posterior, seen.camera, smaller), replace(likelihood, values=fixed)


def _inferred(
    seen: DepthImage, document: Document | None, options: Options, progress: Progress | None, warn: Say, command: str
) -> tuple[Posterior, LikelihoodPrior]:
    """As `infer_image`, of an image that is taken as it is."""
    must_stand = options.assume_stable
    if document is not None and getattr(document.prior, "constraints", None):
        from derender.physics.constraint import without_stands

        prior, said = without_stands(document.prior)
        document, must_stand = replace(document, prior=prior), must_stand or said
    if document is not None and names_objects(document):
        posterior, likelihood = _given(seen, document, options, progress, warn, command)
    else:
        posterior, likelihood = _bare(seen, document, options, progress, warn)
    if must_stand:
        from derender.physics.constraint import assume_stable

        posterior, share = assume_stable(posterior)
        if share < 1.0:
            warn(f"given that the scene stands, {share:.0%} of the posterior is left")
    lost = posterior.meta.get("lost_chains", {})
    for number, why in lost.items():
        warn(f"chain {number} was lost: {why.strip().splitlines()[-1]}")
    meta = {
        "interrupted": False,
        **posterior.meta,
        "method": options.method,
        "camera": seen.camera.to_dict(),
        "camera_guessed": seen.camera_is_guess,
        "lost_chains": sorted(lost),
    }
    return replace(posterior, seed=options.seed, meta=meta), likelihood


def as_enlarged(posterior: Posterior, camera: Camera, enlargement: Enlargement) -> Posterior:
    """Return the posterior of a smaller image as that of the image, of this camera, that was made of it."""
    told, meta = posterior.explanation, {**posterior.meta, "camera": camera.to_dict()}
    if told is not None:
        label, depth = (enlargement.enlarged(each) for each in (told.label, told.depth))
        told = told._replace(label=label, depth=depth)
    if "likelihood" in meta:
        meta["likelihood"] = in_its_pixels(meta["likelihood"], enlargement)
    return replace(posterior, explanation=told, meta=meta)


def in_its_pixels(numbers: Mapping[str, Any], enlargement: Enlargement) -> dict[str, Any]:
    """Return a likelihood's numbers given a smaller image with those in pixels in those of the image made of it."""
    return {**numbers, **{name: enlargement.ratio * numbers[name] for name in IN_PIXELS if name in numbers}}


def _given(
    seen: DepthImage, document: Document, options: Options, progress: Progress | None, warn: Say, command: str
) -> tuple[Posterior, LikelihoodPrior]:
    """Infer the unknown numbers of objects that are given."""
    from derender.posterior.sampler import read_settings
    from derender.structures.given import infer_scene

    precompile("engine")
    import_in_background(*WRITERS)
    said: dict[str, Any] = {"chains": options.chains, "draws": options.draws, "warmup": options.warmup}
    settings = read_settings(document.inference)._replace(**{k: v for k, v in said.items() if v is not None})
    settings = settings._replace(goes_on=options.draws is None and "draws" not in (document.inference or ()))
    posterior, interrupted, lost = infer_scene(
        document, seen.depth, seen.camera, settings, options, command, progress, warn
    )
    likelihood = document.likelihood or LikelihoodPrior()
    drawn = {"drawn": replace(likelihood, values=likelihood.drawn).means} if likelihood.drawn else {}
    meta = {
        **posterior.meta, "interrupted": interrupted, "lost_chains": lost,
        "likelihood": {"type": likelihood.type, **likelihood.fixed, **drawn},  # its unknown numbers are among the draws
    }  # fmt: skip
    return replace(posterior, meta=meta), likelihood


def _bare(
    seen: DepthImage, document: Document | None, options: Options, progress: Progress | None, warn: Say
) -> tuple[Posterior, LikelihoodPrior]:
    """Infer what there is; a document is a prior of open structure."""
    from derender.structures.infer import infer_structure

    precompile("draws")
    rng, told = np.random.default_rng(options.seed), _importing(progress)
    if document is not None and options.method == "mcmc":
        from derender.structures.jumps.run import infer_by_jumps

        posterior = infer_by_jumps(seen.depth, seen.camera, options, document, rng, told)
    else:
        if document is not None:
            options = replace(options, prior=document.prior, likelihood=document.likelihood)
        posterior = infer_structure(seen.depth, seen.camera, options, rng, told)
    if posterior.meta.get("backdrop"):
        share = f"{posterior.meta['backdrop']:.0%} of the pixels lie on a plane or beyond"
        warn(f"{share}: taken as background; with --floor auto solids stand on it")
    fitted: dict[str, Any] = dict(posterior.meta["likelihood"])
    return posterior, LikelihoodPrior(fitted.pop("type"), fitted)


def _importing(progress: Progress | None) -> Progress:
    """Return `progress` that also begins to import what the files need, when the search gives way to long walks."""

    def told(share: float, message: str) -> None:
        if share > 0.0:
            import_in_background(*WRITERS)
        if progress:
            progress(share, message)

    return told
