"""Reads scenarios from files, from text, and from the package."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from consat.errors import Fault, InvalidInput, InvalidScenario, closest
from consat.problem.team import Team
from consat.scenario.document import LARGEST, Document, decode, read
from consat.scenario.overrides import override
from consat.scenario.schema import build
from consat.scenario.writing import write
from consat.settings import Settings

if TYPE_CHECKING:
    from consat.scenario.robots import Robots

_PACKAGE = resources.files("consat.scenario")


@dataclass(frozen=True, eq=False)
class Scenario:
    """A team and the settings of its runs.

    Attributes:
        name: name for reports.
        team: the agents, their constraints and links.
        settings: start, protocol and smoothing.
        text: YAML of this scenario, overrides included; empty if the team has Python functions, which YAML cannot hold.
        source: the file or packaged name it was read from.
        document: the parsed file, with the places of all values; None if the scenario was not read from text.
        robots: robots and obstacles; None if agents are points that move freely.
        rate: rounds per second, Hz; None if not given.
    """

    name: str
    team: Team
    settings: Settings
    text: str = field(repr=False)
    source: str
    document: Document | None = field(default=None, repr=False)
    robots: Robots | None = field(default=None, repr=False)
    rate: float | None = None


def load(source: str | os.PathLike[str], overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario.

    Args:
        source: path of a file, or a packaged name such as ``case-b``. An existing file takes precedence over a packaged name.
        overrides: ``path=value`` texts, e.g. ``start.box=[-9, 9]`` or ``agents.a1.constraints.0.radius=2``.

    Raises:
        InvalidScenario: the scenario has faults. The message names every fault with its line and column.
    """
    file = os.fspath(source)
    text = packaged_text(file) if file in packaged() and not Path(file).is_file() else _text(file)
    return loads(text, file, overrides)


def loads(text: str, name: str = "scenario", overrides: Sequence[str] = ()) -> Scenario:
    """Read a scenario from text.

    Args:
        text: the YAML.
        name: name of the file in messages. It is also the name of the scenario if the text gives none.
        overrides: as in `load`.

    Raises:
        InvalidScenario: the scenario has faults. The message names every fault with its line and column.
    """
    document = read(text, name)
    for each in overrides:
        override(document, each)
    built = build(document)
    if overrides and document.root is not None:
        text = f"# {name!r} with {' '.join(f'--set {each!r}' for each in overrides)}\n{write(document.root.plain)}"
    return Scenario(built.name or Path(name).stem, built.team, built.settings, text, name, document, built.robots, built.rate)


def located(error: InvalidInput, scenario: Scenario) -> InvalidScenario:
    """The error with the places of its faults in the scenario's file. For errors found after loading, such as a disconnected cluster."""
    if isinstance(error, InvalidScenario):
        return error
    document = scenario.document
    return InvalidScenario(error.faults) if document is None else Document(document.file, document.root).invalid(error.faults)


@functools.cache
def packaged() -> tuple[str, ...]:
    """The names of the packaged scenarios."""
    files = (file.name for file in (_PACKAGE / "packaged").iterdir())
    return tuple(sorted(name.removesuffix(".yaml") for name in files if name.endswith(".yaml")))


def packaged_text(name: str) -> str:
    """The YAML of a packaged scenario."""
    return (_PACKAGE / "packaged" / f"{name}.yaml").read_text(encoding="utf-8")


def template() -> str:
    """The YAML of a commented example scenario, to start from."""
    return (_PACKAGE / "template.yaml").read_text(encoding="utf-8")


def _text(file: str) -> str:
    try:
        with Path(file).open("rb") as stream:
            content = stream.read(LARGEST + 1)
    except FileNotFoundError:
        hint = closest(Path(file).stem, packaged())
        message = f"there is no such file or packaged scenario; consat init writes a scenario to begin with{hint}"
    except IsADirectoryError:
        message = "this is a directory, but must be a scenario file"
    except (OSError, ValueError) as error:  # the latter: a null character in the name
        message = f"cannot be read: {getattr(error, 'strerror', None) or error}"
    else:
        return decode(content, file)
    raise InvalidScenario([Fault((), message, file)])
