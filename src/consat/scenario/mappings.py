"""Checks mappings of a scenario, such as ``{kind: within, center: [2, 0], radius: 1}``, against the factories of their kinds.

Constraints, robots and obstacles are checked here, from a file as from the live page. Paths of faults begin at the mapping.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Final

from consat.errors import Fault, InvalidExpression, closest, shown
from consat.problem.constraints import KINDS
from consat.scenario.words import unknown_key

TEXT: Final = (str, str | None, "str", "str | None")
"""Annotations of those arguments of a factory that must be text in a scenario."""


def checked(
    data: Any, kinds: Mapping[str, Callable[..., Any]], where: str, example: str, *, besides: Sequence[str] = (), base: Collection[str] = ()
) -> tuple[dict[str, Any], list[Fault]]:  # fmt: skip
    """Check the keys of a mapping.

    Args:
        data: the mapping.
        kinds: the factory of each kind.
        where: the mapping in words, for faults.
        example: a mapping that would be right.
        besides: keys that are allowed, but not arguments of the factory.
        base: arguments that need not be given.

    Returns:
        the arguments of the factory, without nulls, and the faults. Without a known kind, there are no arguments.
    """
    if not isinstance(data, Mapping):
        return {}, [Fault((), f"it is {shown(data)}, but must be a mapping such as {example}", where)]
    kind = data.get("kind")
    if kind is None:
        return {}, [Fault(("kind",), f"kind is missing; it is one of {', '.join(kinds)}", where)]
    if not isinstance(kind, str) or kind not in kinds:
        return {}, [Fault(("kind",), f"there is no kind {shown(kind)}; the kinds are {', '.join(kinds)}{closest(kind, kinds)}", where)]
    keys = parameters(kinds[kind])
    allowed = ("kind", *keys, *besides)
    faults = [unknown_key((key,), allowed, where) for key in data if key not in allowed]
    given = {key: data[key] for key in keys if data.get(key) is not None}
    needed = required(kinds[kind])
    missing = [key for key in needed if key not in given and key not in base]
    return given, faults + [Fault((key,), f"{key} is missing; {kind} needs {', '.join(needed)}", where) for key in missing]


def constraint(data: Any, where: str, besides: Sequence[str] | None = None) -> tuple[Any, list[Fault]]:
    """Make a constraint from its mapping.

    Args:
        data: the mapping.
        where: the constraint in words, for faults.
        besides: in a group, keys that are allowed but not arguments of the factory; None outside of a group.

    Returns:
        a constraint, or a list of them for a box, and the faults. With faults, the constraint serves only to find others; it is an empty
        list if there is nothing to find.
    """
    example = "{kind: within, center: [2, 0], radius: 1}"
    given, faults = checked(data, KINDS, where, example, besides=besides or ())
    if not (isinstance(data, Mapping) and isinstance(data.get("kind"), str) and data["kind"] in KINDS):
        return [], faults
    factory = KINDS[data["kind"]]
    for key, parameter in parameters(factory).items():
        text = besides is None if key == "agent" else parameter.annotation in TEXT
        if key in given and text and not isinstance(given[key], str):
            faults.append(Fault((key,), f"{key} is {shown(given.pop(key))}, but must be text; put numbers in quotes", where))
    try:
        return factory(**dict.fromkeys(required(factory), "") | given), faults
    except InvalidExpression as error:
        fault = Fault(("psi",), error.message, where, error.column)
        return [], faults if any(each.path == fault.path for each in faults) else [*faults, fault]


@functools.cache
def parameters(factory: Callable[..., Any]) -> Mapping[str, inspect.Parameter]:
    """The parameters of a factory, by name."""
    return inspect.signature(factory).parameters


def required(factory: Callable[..., Any]) -> list[str]:
    """Names of the parameters without a default."""
    return [name for name, each in parameters(factory).items() if each.default is each.empty]
