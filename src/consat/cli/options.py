"""Types of options, and the arguments and options that several commands share."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, get_args

import click

from consat.cli.completion import scenarios


class Burst(click.ParamType[tuple[float, float]]):
    """Type of an option: two probabilities ``P,Q``."""

    name = "P,Q"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        try:
            p, q = value if isinstance(value, tuple) else map(float, str(value).split(","))
        except ValueError:
            self.fail(f"it is {value!r}, but must be two probabilities, such as 0.05,0.5", param, ctx)
        return p, q


class OneOf(click.Choice[str]):
    """Type of an option whose choices stand in a registry. It is imported when the choices are needed, because imports take time.

    Args:
        listed: returns the choices.
    """

    def __init__(self, listed: Callable[[], Iterable[str]]) -> None:
        self._listed, self.case_sensitive = listed, True

    @property
    def choices(self) -> tuple[str, ...]:  # type: ignore[override]
        """The names in the registry."""
        return tuple(self._listed())


class Listing(click.Option):
    """Option whose help lists the names of a registry, in place of ``{}``. The registry is imported when the help is shown.

    Args:
        listed: returns the names.
        given: as of `click.Option`.
        options: as of `click.Option`.
    """

    def __init__(self, *given: Any, listed: Callable[[], Iterable[str]], **options: Any) -> None:
        super().__init__(*given, **options)
        self._listed = listed

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Option and help."""
        self.help = (self.help or "").format(", ".join(self._listed()))
        return super().get_help_record(ctx)


def words(module: str, of: str) -> Callable[[], Iterable[str]]:
    """Function that imports a module and returns the values of a literal type of it, or the names in a registry."""

    def listed() -> Iterable[str]:
        found = getattr(importlib.import_module(module), of)
        return get_args(found) or found

    return listed


films = words("consat.views.animation", "FORMATS")
scenario_argument = click.argument("scenario", metavar="FILE", shell_complete=scenarios)
set_option = click.option("--set", "overrides", multiple=True, metavar="PATH=VALUE", help="Change the scenario, e.g. start.box=[-9,9].")
estimates_option = click.option(
    "--estimates", type=OneOf(words("consat.settings", "Layout")), help="Who holds copies: what is needed, or everything."
)
sends_option = click.option(
    "--sends", type=OneOf(words("consat.settings", "Sends")), default="all", help="In every round, or only what is news to a neighbour."
)
out_option = click.option(
    "--out", type=click.Path(file_okay=False, path_type=Path), metavar="DIR", help="Write the result and its figures there."
)
force_option = click.option("--force", is_flag=True, help="Overwrite results of another scenario in --out.")
full_option = click.option("--full", is_flag=True, help="List every agent in the JSON, however many.")
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON document on stdout and nothing else.")
