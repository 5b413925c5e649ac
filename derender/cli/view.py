"""derender view: the page about a result, in a browser."""

from pathlib import Path

import click

from derender.cli import options
from derender.cli.options import Talk
from derender.errors import DerenderError


@click.command()
@click.argument("folder", metavar="DIR")
@click.option("--open/--no-open", "show", default=True, help="Open the page in a browser.")
@options.quiet
def command(folder: str, show: bool, talk: Talk) -> None:
    """Open the page about what `derender infer` left in DIR, made anew where it is missing or older than what it shows.

    Of many frames (`derender infer FRAMES... -o DIR`) it is DIR/index.html. stdout has the page's place, so that
    another program can open it; the page needs no network.

    \b
    Examples:
        derender view results/
        xdg-open $(derender view results/ --no-open)
    """
    from derender.cli.reading import MOVING
    from derender.cli.report import gathered
    from derender.report.html import write_report
    from derender.report.result_folder import SIMULATION

    place = Path(folder)
    if not place.is_dir():
        raise DerenderError("there is no such folder", folder, "give a DIR made by derender infer")
    page, posterior = place / "report.html", place / "posterior.npz"
    shown = [path for path in place.iterdir() if path.name in (posterior.name, SIMULATION) or path.suffix in MOVING]
    if (place / "index.html").is_file() and not posterior.exists():
        page = place / "index.html"
    elif not page.is_file() or any(page.stat().st_mtime < path.stat().st_mtime for path in shown):
        write_report(page, gathered([folder])[0])
        talk.say(f"wrote {page}")
    click.echo(str(page))
    if show:
        import webbrowser

        if not webbrowser.open(page.resolve().as_uri()):
            talk.warn("no browser was found here: open the page by hand")
