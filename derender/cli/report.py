"""derender report: HTML and tables from one or more posteriors."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from derender.cli import options
from derender.cli.options import Talk
from derender.errors import DerenderError

if TYPE_CHECKING:
    from derender.report.contents import Report


@click.command()
@click.argument("folders", nargs=-1, required=True, metavar="DIR...")
@options.output(
    "Where to write the page. Default: report.html in DIR; of several report_together.html in the first.", "FILE.html"
)
@click.option("--table/--no-table", default=True, help="Print the table of parameters on stdout.")
@options.quiet
def command(folders: tuple[str, ...], output: str | None, table: bool, talk: Talk) -> None:
    """Write one HTML page, which needs no network, about what `derender infer` left in DIR; print its table.

    Several DIRs are runs on the same image with different seeds: their chains are put together, and R-hat compares
    them. A scene file is reported too, without what only a posterior has. The page shows what `derender simulate
    DIR` found last, with its --animate DIR/FILE.gif (or .webp).

    \b
    Examples:
        derender report results/
        derender report run_1/ run_2/ run_3/ -o all.html
        derender report results/ --table > table.txt
        derender simulate results/ && derender report results/
    """
    from derender.report.html import write_report
    from derender.report.result_folder import TOGETHER
    from derender.report.tables import parameter_table
    from derender.results.trust import trusted, verdict

    if output is not None and Path(output).suffix.lower() not in (".html", ".htm"):
        raise DerenderError("a report is HTML", output, "give a name that ends in .html")
    report, name = gathered(folders)
    if output is None:
        place = Path(folders[0])
        page = "report.html" if len(folders) == 1 else TOGETHER
        output = str(place / page) if place.is_dir() else f"{name}.html"
    write_report(output, report)
    talk.say(f"wrote {output}")
    if table and report.parameters:
        click.echo(parameter_table(report.parameters))
    for line in verdict(report.doubts, report.parameters):
        talk.say(line, always=not trusted(report.doubts))


def gathered(folders: Sequence[str]) -> tuple["Report", str]:
    """Return what a page about these results shows, and the name of the first."""
    import numpy as np

    from derender.cli.reading import read_explained, read_observation, read_scene, read_simulation
    from derender.report.contents import likelihood_numbers, report_of

    found = [read_scene(folder) for folder in folders]
    first = found[0]
    posterior = first.posterior
    if len(found) > 1:
        from derender.results.posterior import merge_runs

        posteriors = []
        for name, each in zip(folders, found, strict=True):
            if each.posterior is None:
                raise DerenderError("only posteriors can be put together", name, "give DIRs made by derender infer")
            posteriors.append(each.posterior)
        posterior = merge_runs(posteriors, folders)
        images = [image for folder in folders if (image := read_observation(folder)) is not None]
        if not all(np.array_equal(images[0][0], depth, equal_nan=True) for depth, _ in images):
            raise DerenderError("these were not inferred from the same image", ", ".join(folders), "report them apart")
    graph = first.graph if posterior is None else posterior.best_graph()
    place = Path(folders[0]) if folders[0] != "-" and Path(folders[0]).is_dir() else None
    image = read_observation(place) if place else None
    observed, camera = image if image is not None else (None, first.camera)
    names = ", ".join(each.name for each in found)
    if posterior is not None and len(found) == 1:  # as the page that `infer` wrote
        names = Path(str(posterior.meta.get("image", names))).name
    told = read_explained(place, image[1].shape) if place and image is not None else None
    facts = {"chains of": f"{len(found)} runs"} if len(found) > 1 else {}
    if (
        posterior is not None
        and len({each.posterior.best_part.values.shape[1] for each in found if each.posterior}) > 1
    ):
        facts["draws of each chain"] = f"{posterior.best_part.values.shape[1]}: all are cut to the shortest"
    sensor = likelihood_numbers(first.likelihood)
    report = report_of(graph, camera, observed, posterior, names, facts, sensor, told=told)
    if place is None:
        return report, first.name
    simulated, animations = read_simulation(place)
    report = report._replace(simulated=simulated, animations=animations)
    if len(found) == 1 and (place / "scene.yaml").is_file():
        files = {"scene.yaml": ("text/yaml", (place / "scene.yaml").read_bytes())}
        report = report._replace(files={**files, **report.files})
    return report, first.name
