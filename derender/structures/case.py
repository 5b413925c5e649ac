"""What is asked of one image: its camera, the settings of the search that options ask for, the unit of its lengths."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.camera.intrinsics import Camera
from derender.detection.fattening import fattened, thinned
from derender.detection.floor import read_floor
from derender.detection.rounding import dithered
from derender.detection.search.greedy import Settings
from derender.detection.solids.beliefs import Beliefs, beliefs_of
from derender.detection.unit import unit_of
from derender.errors import DerenderError
from derender.scene.priors.bare_image import BareImagePrior
from derender.structures.options import Frame, Options

# Chains of each structure, and draws of each chain, where options say nothing: a quantile of as few as 200 draws is off
# by so much that 90 % intervals held 1 to 4 of 100 numbers less than those of 800.
CHAINS, DRAWS = 2, 200


class Case(NamedTuple):
    """An image to explain, and what is asked."""

    depth: np.ndarray  # (H, W) metres, NaN = no return
    camera: Camera  # its Camera
    frames: Sequence[Frame]  # further images of the same scene
    options: Options
    settings: Settings  # of the search, as asked
    library: Any  # of known objects, empty: none
    plane: Any  # the floor as it is given, see detection.floor.read_floor; None: find it
    fattened: bool  # whether its silhouettes were a pixel wider as it came, see `detection.fattening`

    @property
    def beliefs(self) -> Beliefs:
        """What is believed before the image is seen."""
        return self.settings.believed

    @property
    def many(self) -> tuple[int, int]:
        """How many chains there are of each structure, and draws of each chain."""
        return self.options.chains or CHAINS, self.options.draws or DRAWS

    @property
    def only_best(self) -> bool:
        """Whether the best scene is all that is asked for."""
        return self.options.method == "map"


def case_of(rng: np.random.Generator, image: np.ndarray, camera: Camera, options: Options) -> Case:
    """Return the Case of an image; frames from where its own camera stood are averaged with it."""
    from derender.structures.known.library import read_library
    from derender.structures.together import averaged

    depth = np.where(np.isfinite(image) & (image > 0), image, np.nan)
    depth, frames = averaged(depth, camera, options.frames)
    wide = fattened(depth)
    depth = dithered(rng, thinned(depth) if wide else depth, camera)
    frames = [frame._replace(depth=thinned(frame.depth)) if fattened(frame.depth) else frame for frame in frames]
    frames = [frame._replace(depth=dithered(rng, frame.depth, frame.camera)) for frame in frames]
    known = options.known or ()
    library = read_library(known) if isinstance(known, str | Path) else tuple(known)
    return Case(depth, camera, frames, options, settings_of(options), library, read_floor(options.floor), wide)


def unit_of_lengths(case: Case) -> float:
    """Return the metres in which to count lengths: 1 where the unit is known, or others say how long things are."""
    options = case.options
    said = options.known or not isinstance(options.prior, BareImagePrior | None)
    if said or options.unit is not None or options.frames:
        return 1.0
    return unit_of(case.depth, case.beliefs.loose)


def settings_of(options: Options) -> Settings:
    """Return the Settings that Options ask for: of an open prior among them which shapes there are, how many objects at
    most, whether they may interpenetrate and float; an option is stricter or looser still."""
    settings = Settings()
    prior = options.prior
    if prior is not None:
        kinds = {entry.type for entry in prior.shapes.values()}
        terms = {term.name: term for term in prior.constraints}
        if not kinds & set(settings.shapes):
            remedy = "the search knows " + ", ".join(settings.shapes)
            raise DerenderError("the prior has no shape that can be looked for", "shapes", remedy)
        settings = settings._replace(
            beliefs=beliefs_of(prior, options.likelihood),
            shapes=tuple(name for name in settings.shapes if name in kinds),
            may_overlap="no-overlap" not in terms,
            may_float="no-floating" not in terms and any(rule.type == "6dof" for rule in prior.contacts.rules),
        )
        if "at-most" in terms:
            settings = settings._replace(max_objects=terms["at-most"].count, counts_all=True)
    if options.shapes:
        settings = settings._replace(shapes=tuple(options.shapes))
    if options.max_objects:
        settings = settings._replace(max_objects=options.max_objects, counts_all=True)
    said = options.shapes or options.known or not isinstance(prior, BareImagePrior | None)
    if said or (isinstance(options.floor, str) and options.floor == "none"):
        settings = settings._replace(free_forms=False)  # what there may be is said, or nothing that it could stand on
    if options.quick:
        settings = settings._replace(tries=1)
    if options.budget is not None:
        settings = settings._replace(until=time.monotonic() + options.budget)
    return settings._replace(
        may_overlap=settings.may_overlap or options.may_overlap, may_float=settings.may_float or options.may_float
    )
