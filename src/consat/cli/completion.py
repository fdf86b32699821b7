"""Shell completion: packaged scenarios and files, results, protocols, ids of agents."""

from __future__ import annotations

from pathlib import Path
from typing import Final, get_args

import click
from click.shell_completion import CompletionItem

from consat.errors import ConsatError

FILES: Final = (".yaml", ".yml")
MOST: Final = 200
"""Largest number of agents that are offered."""


def scenarios(context: click.Context, parameter: click.Parameter, text: str) -> list[CompletionItem]:
    """Packaged scenarios, scenario files and directories."""
    from consat.scenario import packaged

    return [CompletionItem(name, help="packaged") for name in packaged() if name.startswith(text)] + _files(text, FILES)


def results(context: click.Context, parameter: click.Parameter, text: str) -> list[CompletionItem]:
    """Result files and directories."""
    return _files(text, (".nc",))


def _files(text: str, endings: tuple[str, ...]) -> list[CompletionItem]:
    folder, _, start = text.rpartition("/")
    place = Path(folder or ("/" if text.startswith("/") else "."))
    try:
        entries = sorted(place.iterdir())
    except OSError:
        return []
    before = text[: len(text) - len(start)]
    found = []
    for entry in entries:
        if entry.name.startswith(start) and not (entry.name.startswith(".") and not start):
            if entry.is_dir():
                found.append(CompletionItem(f"{before}{entry.name}/"))
            elif entry.suffix in endings:
                found.append(CompletionItem(before + entry.name))
    return found


def protocols(context: click.Context, parameter: click.Parameter, text: str) -> list[CompletionItem]:
    """Names of protocols."""
    from consat.settings import ProtocolKind

    return [CompletionItem(kind) for kind in get_args(ProtocolKind) if kind.startswith(text)]


def agents(context: click.Context, parameter: click.Parameter, text: str) -> list[CompletionItem]:
    """Ids of the agents of the scenario on the command line; after a comma, those that are not listed yet."""
    from consat.scenario import load

    scenario = context.params.get("scenario") or next(iter(context.args), None)  # in `args` while the option has no value yet
    if not isinstance(scenario, str):
        return []
    try:
        ids = load(scenario).team.ids
    except ConsatError:
        return []
    before, comma, start = text.rpartition(",")
    taken = before.split(",")
    offered = [name for name in ids[:MOST] if name.startswith(start) and name not in taken]
    return [CompletionItem(before + comma + name) for name in offered]
