"""``consat export`` and ``consat show``: write a saved result in another format."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click

from consat.cli.completion import results
from consat.network.deploy.environment import keep_compilations

result_argument = click.argument("result", type=click.Path(path_type=Path), shell_complete=results)


@click.command()
@result_argument
@click.option(
    "--to", "target", required=True, type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
    help="Its ending says what kind: .csv, .gif, .html, .mcap or .mp4.",
)  # fmt: skip
def export(result: Path, target: Path) -> None:
    """Write a saved RESULT as CSV, GIF, HTML, MCAP or MP4.

    RESULT is a file, or the DIR of a run. CSV has a row for each agent at each time or round; HTML replays the run offline;
    MCAP opens in Foxglove (consat[mcap]); MP4 needs consat[video].
    """
    keep_compilations(os.environ)
    from consat.results.result import Result
    from consat.views.export import save

    loaded, hidden = Result.load(result), not sys.stderr.isatty() or target.suffix.lower() not in (".gif", ".mp4")
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
