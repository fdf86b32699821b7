"""``consat live``: show and control a team in a web page."""

from __future__ import annotations

import os
from collections.abc import Iterable
from typing import Any

import click

from consat.cli.options import Listing, scenario_argument, set_option
from consat.cli.terminal import located
from consat.network.deploy.environment import keep_compilations


def _in_rounds() -> Iterable[str]:
    from consat.protocols import ROUNDS

    return ROUNDS


@click.command()
@scenario_argument
@set_option
@click.option("--host", default="127.0.0.1", show_default=True, help="Where to listen; others than this machine get in with a token.")
@click.option("--port", type=click.IntRange(0, 65535), default=None, help="Where to listen; 8137, or a free one, if not given.")
@click.option("--open/--no-open", "opens", default=True, help="Open the page in a browser.")
@click.option("--protocol", metavar="KIND", cls=Listing, listed=_in_rounds, help="One of {}; interior-point if not given.")
@click.option("--seed", type=click.IntRange(min=0), help="Of starts, and of what gets lost.")
@click.option("--loss", type=click.FloatRange(0, 1, max_open=True), default=0.0, help="Probability that a message is lost.")
def live(scenario: str, overrides: tuple[str, ...], host: str, port: int | None, opens: bool, **settings: Any) -> None:
    """Watch a team, and take hold of it, on a page.

    FILE is a scenario. The page shows the team as it runs: drag its goals, kill agents, cut links. Ctrl-C ends it.
    """
    keep_compilations(os.environ)
    from consat.scenario import load
    from consat.server.handle import live as serve
    from consat.server.handle import require

    require()

    loaded = load(scenario, overrides)
    click.echo(f"compiling {loaded.name} …", err=True)
    with located(loaded):
        page = serve(loaded, host=host, port=port, open_page=False, block=False, widget=False, **settings)
    click.echo(page.url)
    click.echo("Ctrl-C ends it", err=True)
    if opens:
        click.launch(page.url)
    page.wait()
