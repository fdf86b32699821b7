"""``consat export`` and ``consat show``: write a saved result in another format."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from pathlib import Path

import click

from consat.cli.completion import results
from consat.cli.options import Listing, films
from consat.network.deploy.environment import keep_compilations

result_argument = click.argument("result", type=click.Path(path_type=Path), shell_complete=results)


def _formats() -> Iterable[str]:
    from consat.views.export import FORMATS

    return FORMATS


@click.command()
@result_argument
@click.option(
    "--to", "target", required=True, type=click.Path(dir_okay=False, path_type=Path), metavar="FILE", cls=Listing, listed=_formats,
    help="File to write. Its ending is one of {}.",
)  # fmt: skip
def export(result: Path, target: Path) -> None:
    """Write a saved RESULT in another format.

    RESULT is a file, or the DIR of a run. CSV has a row for each agent at each time or round; HTML replays the run offline;
    MCAP opens in Foxglove (consat[mcap]); MP4 needs consat[video].
    """
    keep_compilations(os.environ)
    from consat.results.result import Result
    from consat.views.export import save

    loaded, hidden = Result.load(result), not sys.stderr.isatty() or target.suffix.lower() not in films()
    with click.progressbar(length=100, label="drawing", file=sys.stderr, hidden=hidden) as bar:
        written = save(loaded, target, progress=lambda done: bar.update(round(100 * done) - bar.pos))
    click.echo(written)


@click.command()
@result_argument
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), metavar="PAGE", help="Where to; beside the result if not given.")
@click.option("--open/--no-open", "opens", default=None, help="Open it in a browser; so it is on a terminal, without --out.")
def show(result: Path, out: Path | None, opens: bool | None) -> None:
    """Replay a saved RESULT in a page.

    RESULT is a file, or the DIR of a run. The page is one HTML file that works offline.
    """
    keep_compilations(os.environ)
    import webbrowser

    from consat.results.result import RESULT, Result
    from consat.views.replay import save

    file = result / RESULT if result.is_dir() else result
    page = save(Result.load(result), out or file.with_suffix(".html"))
    click.echo(page)
    if opens or (opens is None and out is None and sys.stdout.isatty()):
        webbrowser.open(page.resolve().as_uri())
