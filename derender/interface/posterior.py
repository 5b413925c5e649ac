"""A posterior for use from Python: what was found, how sure it is, and what it predicts."""

import tempfile
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from derender.camera.depth_file import DepthImage
from derender.camera.intrinsics import Camera
from derender.document import LikelihoodPrior
from derender.errors import DerenderError, optional
from derender.interface.scene import Scene, axes_for, picture_html, plot_depth, table_html
from derender.interface.words import in_python, in_pythons_words
from derender.physics.outcome import Chance, Outcome, probability
from derender.registry import only_its_keywords, suggest
from derender.report import pictures
from derender.report.scene_json import scene_json
from derender.report.tables import text_table
from derender.report.tree_text import structure_words, told_structures
from derender.results import posterior as kept
from derender.results.predictive import blocks_of, predictive_images, write_netcdf
from derender.results.table import EXTENTS, digits, extents_text, type_text
from derender.scene.graph import SceneGraph

MOST_DRAWS = 100_000  # simulated where an error is asked for
MOST_BARS, MOST_LINES = 12, 4  # structures in one plot, and in a notebook's page
BAR = 0.6  # height of a bar, in lines of text
FONTS = (10, 9, 8, 7, 6, 5)  # points, the largest first, of words in a plot
CHARACTER, LINE = 0.62, 1.25  # width of a character and height of a line of matplotlib's font, in its size


class Structure(NamedTuple):
    """One structure of a posterior.

    probability : of the structure, among those that were found.
    words : what rests on what.
    scene : its most probable Scene.
    """

    probability: float
    words: str
    scene: Scene


class Found(NamedTuple):
    """One object of a posterior's most probable scene.

    name, type : of the object; type_probability : of each type that it may be of, given that it is there.
    size : (3,) metres, full extents along its own axes; size_interval : (3, 2), the ends of their 90 % ranges, and
        size_error : (3,), half of those; NaN: no draws.
    pose : (4, 4), object to camera.
    parent : what it rests on; parent_probability : of each thing that it may rest on, by name.
    probability : that the object is there. trusted : whether no doubt is about it; None where nobody judged it.
    """

    name: str
    type: str
    size: np.ndarray
    size_interval: np.ndarray
    pose: np.ndarray
    parent: str
    parent_probability: dict[str, float]
    probability: float
    type_probability: dict[str, float]
    trusted: bool | None = None

    @property
    def size_error(self) -> np.ndarray:
        """(3,) metres."""
        return 0.5 * (self.size_interval[:, 1] - self.size_interval[:, 0])


class Objects(tuple[Found, ...]):
    """The objects of a posterior, a tuple of `Found`, by number or by name."""

    HEAD = ("object", "type", "size (± half of the 90 % range), cm", "rests on", "p")

    def rows(self) -> list[tuple[str, ...]]:
        """Return what is known of each in words, as HEAD names it."""
        told: list[tuple[str, ...]] = []
        for found in self:
            words = extents_text(found.size, found.size_interval if np.isfinite(found.size_interval).all() else None)
            kind = type_text(found.type, found.type_probability[found.type])
            told.append((found.name, kind, words, found.parent, digits(found.probability)))
        return told

    def __repr__(self) -> str:
        return text_table(self.rows(), self.HEAD)

    def _repr_html_(self) -> str:
        return table_html(self.HEAD, self.rows())

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, str):
            for found in self:
                if found.name == key:
                    return found
            raise KeyError(f"no object is called {key!r}; {suggest(key, [found.name for found in self])}")
        return super().__getitem__(key)

    def to_pandas(self) -> Any:
        """Return a pandas.DataFrame with a row for each object: sizes and places in metres.

        Raises DerenderError : pandas is not installed.
        """
        pandas = optional("pandas", "pandas is not installed", "pip install pandas")
        rows = []
        for found in self:
            row: dict[str, Any] = {
                "name": found.name,
                "type": found.type,
                "type_probability": found.type_probability[found.type],
            }
            for k, side in enumerate(EXTENTS):
                low, high = map(float, found.size_interval[k])
                row |= {side: float(found.size[k]), f"{side}_error": float(found.size_error[k])}
                row |= {f"{side}_low": low, f"{side}_high": high}
            row |= dict(zip("xyz", map(float, found.pose[:3, 3]), strict=True))
            rows.append(row | {"rests_on": found.parent, "probability": found.probability, "trusted": found.trusted})
        return pandas.DataFrame(rows)


@dataclass(frozen=True, repr=False)
class Posterior(kept.Posterior):
    """A posterior over scenes, as `derender.infer` and `derender.load` return it.

    parts : the structures found, each with its draws; see `derender.results.posterior`.
    seed, command, version, meta : what made it, and what else is known.
    image : the DepthImage that it explains, or None where the folder has none.

    >>> import derender
    >>> image = derender.sample("stack", seed=0).render(derender.Camera.from_field_of_view(48, 36), noise=True)
    >>> posterior = derender.infer(image, prior="stack", method="map")
    >>> posterior.best
    <Scene: floor, green, red, yellow>
    >>> posterior.objects["yellow"].parent
    'red'
    >>> posterior.structures[0].probability
    1.0
    >>> posterior.predictive(2).shape
    (2, 36, 48)
    """

    image: DepthImage | None = None

    @classmethod
    def of(cls, posterior: kept.Posterior, image: DepthImage | None) -> "Posterior":
        """Return a posterior with the image that it explains."""
        return cls(**{f.name: getattr(posterior, f.name) for f in fields(posterior) if f.name != "image"}, image=image)

    @property
    def camera(self) -> Camera | None:
        """The camera of its image."""
        if self.image is not None:
            return self.image.camera
        return Camera(**self.meta["camera"]) if "camera" in self.meta else None

    @property
    def best(self) -> Scene:
        """The most probable Scene."""
        return self._scene(self.best_graph())

    @property
    def structures(self) -> tuple[Structure, ...]:
        """The structures found, the most probable first."""
        ordered = sorted(self.parts, key=lambda part: -part.weight)
        return tuple(
            Structure(float(part.weight), structure_words(part.graph), self._scene(part.best()[0])) for part in ordered
        )

    @property
    def objects(self) -> Objects:
        """The objects of the most probable scene that have a size, with what is known of each."""
        found = []
        for item in scene_json(self.best_graph(), self)["objects"]:
            if item["size"] is None:
                continue
            interval = np.array(item["size_interval"] or np.full((3, 2), np.nan))
            found.append(
                Found(
                    item["name"], item["type"], np.array(item["size"]), interval, np.array(item["pose"]),
                    item["parent"], item["parent_probability"], item["probability"], item["type_probability"],
                    item.get("trusted"),
                )
            )  # fmt: skip
        return Objects(found)

    @property
    def trusted(self) -> bool | None:
        """Whether the result is to be trusted; None where nobody judged it."""
        return self.meta.get("trusted")

    @property
    def doubts(self) -> tuple[str, ...]:
        """What speaks against trusting it, a sentence each."""
        return tuple(map(in_python, self.meta.get("doubts", ())))

    @only_its_keywords
    def sample_scenes(self, count: int, seed: int = 0) -> list[Scene]:
        """Return `count` scenes drawn from the posterior: structures by their probability, draws uniformly within."""
        return [self._scene(graph) for graph in self.graphs(np.random.default_rng(seed), count)]

    @only_its_keywords
    def predictive(self, count: int, seed: int = 0) -> np.ndarray:
        """Return (count, H, W) float64 depth images, metres, drawn from the posterior with their noise.

        Raises DerenderError : neither image nor camera is known.
        """
        if self.camera is None:
            raise DerenderError("the posterior knows no camera", remedy="load the folder that derender infer wrote")
        return predictive_images(self, self.camera, count, np.random.default_rng(seed))

    @in_pythons_words
    @only_its_keywords
    def probability(
        self,
        event: Callable[[Outcome], bool] | str,
        *,
        draws: int = 200,
        until: float | None = None,
        engine: str = "mujoco",
        duration: float = 2.0,
        jobs: int = 1,
        seed: int = 0,
        push: str | Sequence[str] = (),
        remove: str | Sequence[str] = (),
        add: str | Sequence[str] = (),
        tilt: str | None = None,
        shake: str | None = None,
        jitter: str | None = None,
    ) -> Chance:
        """Return how probable something is to happen: (probability, standard error, draws simulated).

        event : what a `derender.physics.outcome.Outcome` must be like; or a verdict ("stands", "settles", "falls"); or
            the name of an object that moves.
        draws : to simulate. until : instead, as many as it takes to a standard error no greater than this. Neither are
            more than the posterior holds.
        The others are those of `derender.simulate`.

        Of what was missed, with probability `missed`, no draw tells: half of that counts as the event, of settling and
        of falling a quarter each, so that the three verdicts' probabilities sum to one.
        """
        alone = not (self.uncertain or jitter)  # what happens to one scene does in every draw of it
        count = draws if until is None else MOST_DRAWS
        graphs = self.each_graph(np.random.default_rng(seed), min(count, 1) if alone else count)
        return probability(
            graphs, event, until=until, seed=seed, engine=engine, duration=duration, jobs=jobs, missed=self.missed,
            alone=alone, push=push, remove=remove, add=add, tilt=tilt, shake=shake, jitter=jitter,
        )  # fmt: skip

    def to_arviz(self) -> Any:
        """Return what ArviZ works on: an InferenceData, or with ArviZ 1 a DataTree; of the most probable structure.

        Its groups are `posterior`, `sample_stats` and, where the image is known, `observed_data`, `log_likelihood` and
        `posterior_predictive` by blocks of pixels: neighbours share their errors, so a block is one observation. Where
        they share so much that blocks do not count by themselves, as a real sensor's, `log_likelihood` is left out.

        Raises DerenderError : ArviZ is not installed.
        """
        arviz = optional("arviz", "ArviZ is not installed", "pip install 'derender[arviz]'")
        image = self.image
        seen = None if image is None else blocks_of(self, image.depth, image.camera, np.random.default_rng(0))
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "posterior.nc"
            write_netcdf(path, self, seen)
            data = arviz.from_netcdf(str(path))
            return data.load() if hasattr(data, "load") else data

    def plot_depth(self, ax: Any = None) -> Any:
        """Draw the observed depth into matplotlib axes, new ones by default, and return them."""
        if self.image is None:
            raise DerenderError("the posterior does not have its image", remedy="load the folder, not posterior.npz")
        return plot_depth(self.image.depth, ax)

    def plot_sizes(self, ax: Any = None) -> Any:
        """Draw length, width and height of each object with their 90 % ranges into matplotlib axes, and return them."""
        axes, objects = axes_for(ax), self.objects
        places = np.arange(len(objects))
        sizes = 1000 * np.array([found.size for found in objects]).reshape(-1, len(EXTENTS))
        ranges = 1000 * np.array([found.size_interval for found in objects]).reshape(-1, len(EXTENTS), 2)
        errors = np.maximum((ranges - sizes[..., None]) * [-1, 1], 0.0)  # of a value outside its range one is none
        for number, side in enumerate(EXTENTS):
            told = sizes[:, number], errors[:, number].T
            axes.errorbar(places + 0.2 * (number - 1), *told, fmt="o", capsize=3, label=side)
        axes.set_xticks(places, [found.name for found in objects], rotation=30, ha="right")
        axes.set_ylabel("mm, 90 % range" if np.isfinite(errors).any() else "mm")
        axes.set_ylim(0, 1.1 * max(np.max(sizes, initial=1.0), np.max(np.nan_to_num(ranges), initial=1.0)))
        axes.legend()
        return axes

    def plot_structures(self, ax: Any = None) -> Any:
        """Draw the structures' probabilities into matplotlib axes, and return them.

        Each has a bar, the greatest on top, and above it what it says, in as many lines as that takes.
        """
        axes = axes_for(ax)
        told = told_structures(self)[:MOST_BARS]
        size, lines = fitted_lines(axes, [f"p {each.text}  {each.words}" for each in told])
        rows = np.cumsum([text.count("\n") + 1 + BAR for text in lines])  # counted in lines of text, from the top
        axes.barh(rows - 0.5 * BAR, [each.probability for each in told], BAR)
        for row, text in zip(rows, lines, strict=True):
            axes.text(0.01, row - BAR, text, fontsize=size, va="bottom", linespacing=1.0)
        axes.set_ylim(rows[-1] + 0.5 * BAR, -0.5 * BAR)
        axes.set_yticks([])
        axes.set_xlim(0, 1)
        axes.set_xlabel("probability")
        return axes

    def _repr_html_(self) -> str:
        shown = ""
        if self.image is not None:
            depth = self.image.depth
            shown = picture_html(pictures.paint(depth, *pictures.depth_limits(depth)), "observed depth")
        likely = "<br>".join(f"p {each.text} {escape(each.words)}" for each in told_structures(self)[:MOST_LINES])
        told = "".join(f"<li>{escape(doubt)}</li>" for doubt in self.doubts)
        judged = "" if self.trusted is None else f"<p><b>{'trusted' if self.trusted else 'not to be trusted'}</b></p>"
        table = self.objects._repr_html_()
        return f"<div>{shown}{self.best.picture_html()}<p>{likely}</p>{table}{judged}<ul>{told}</ul></div>"

    def _scene(self, graph: SceneGraph) -> Scene:
        told = dict(self.meta.get("likelihood") or {})
        kind = told.pop("type", None)
        drawn = told.pop("drawn", {})
        return Scene(graph, self.camera, None if kind is None else LikelihoodPrior(kind, told, drawn))


def fitted_lines(axes: Any, texts: list[str]) -> tuple[int, list[str]]:
    """Return a font size in points, and texts broken into lines, with which bars and texts fit into matplotlib axes."""
    width, height = 72.0 / axes.figure.dpi * np.array(axes.get_window_extent().size)
    for size in FONTS:
        columns = max(1, int(0.98 * width / (CHARACTER * size)))
        broken = [textwrap.fill(text, columns) for text in texts]
        if (sum(text.count("\n") + 1 + BAR for text in broken) + BAR) * LINE * size <= height:
            break
    return size, broken
