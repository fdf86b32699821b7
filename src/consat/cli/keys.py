"""``consat keys``: make keys and certificates for the agents of a team."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from consat.errors import counted


@click.command()
@click.argument("agents", nargs=-1, required=True, metavar="FILE | ID…")
@click.option("--out", required=True, type=click.Path(file_okay=False, path_type=Path), metavar="DIR", help="Where to.")
@click.option(
    "--address", "addresses", multiple=True, help="IP address or host name of a machine of the team, besides 127.0.0.1; repeat it."
)
@click.option("--days", type=click.IntRange(1, 3650), default=365, show_default=True, help="For which the agents' certificates are valid.")
@click.option("--replace", is_flag=True, help="Renew the keys of agents that have some; the authority stays.")
@click.option("--set", "overrides", multiple=True, metavar="PATH=VALUE", help="Change the scenario, e.g. count=5.")
def keys(agents: tuple[str, ...], out: Path, addresses: tuple[str, ...], days: int, replace: bool, overrides: tuple[str, ...]) -> None:
    """Make keys and certificates for the agents of a team.

    That is a certificate authority, and a certificate for each agent: of a scenario, or of the IDs given.
    """
    from consat.network.keys import make
    from consat.network.names import CA_KEY

    ids = _ids(agents, overrides)
    make(ids, out, addresses=addresses, days=days, replace=replace)
    click.echo(f"keys of {counted(len(ids), 'agent')} written to {out}", err=True)
    click.echo(f"give each agent its own folder, and nobody {out / CA_KEY}: who has it can be any agent", err=True)


def _ids(agents: tuple[str, ...], overrides: tuple[str, ...]) -> Sequence[str]:
    from consat.scenario import load, packaged

    first = agents[0]
    if len(agents) == 1 and (first in packaged() or first.endswith((".yaml", ".yml")) or Path(first).is_file()):
        return load(first, overrides).team.ids
    if overrides:
        raise click.UsageError("--set changes a scenario, but agents are named; leave it out")
    return list(dict.fromkeys(agents))
