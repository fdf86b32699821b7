"""Translates pydantic's errors about the settings to faults in the terms of a scenario file."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from consat.errors import AT_KEY, Fault, closest, dotted, shown
from consat.scenario.document import Path
from consat.settings import Settings


def unknown_key(path: Path, allowed: Collection[str], where: str = "") -> Fault:
    """The fault for an unknown key.

    Args:
        path: path that ends with the key.
        allowed: the known keys.
        where: the place in words; by default the dotted path of the parent.
    """
    message = f"there is no key {shown(path[-1])}; the keys are {', '.join(allowed)}{closest(path[-1], allowed)}"
    return Fault(path, message, where or dotted(path[:-1]) or "scenario", AT_KEY)


def complaints(error: ValidationError, data: Mapping[str, Any]) -> list[Fault]:
    """The faults of `data` that failed validation as `Settings`: one for each value, and of nested values only the innermost.

    For a value that may take several forms, pydantic reports an error for each form. They are merged into one fault, which says what the
    value must be.
    """
    found: dict[Path, Fault] = {}
    for item in error.errors(include_url=False):
        path = _path(item, data)
        if path not in found or item["type"] == "rule":
            found[path] = _fault(path, item, data)
    return [fault for path, fault in found.items() if not any(len(other) > len(path) and other[: len(path)] == path for other in found)]


def _path(item: ErrorDetails, data: Any) -> Path:
    """The path in `data` of a pydantic error. Pydantic's own path also contains the names of the forms it tried; they are left out."""
    path: list[str | int] = []
    for part in item["loc"]:
        if isinstance(data, dict) and part in data:
            path.append(part)
            data = data[part]
    last = item["loc"][-1]
    return (*path, last) if item["type"] == "missing" and isinstance(last, str) else tuple(path)


def _fault(path: Path, item: ErrorDetails, data: Any) -> Fault:
    where = dotted(path[:-1] or path)
    fields = _fields(path[:-1])
    key = path[-1]
    if item["type"] == "extra_forbidden":
        return unknown_key(path, fields, where)
    if item["type"] == "rule":
        return Fault(path, item["msg"], where)
    wanted = fields[str(key)].description
    for part in path[:-1]:
        data = data[part]
    if key not in data:
        return Fault(path, f"{key} is missing; it must be {wanted}", where)
    data = data[key]
    hint = closest(data, re.findall("'(.+?)'", item["msg"])) if item["type"] == "literal_error" and isinstance(data, str) else ""
    return Fault(path, f"{key} is {shown(data)}, but must be {wanted}{hint}", where)


def _fields(path: Path) -> dict[str, FieldInfo]:
    """The fields of the settings at `path`, by their key in a scenario file."""
    model: type[BaseModel] = Settings
    for part in path:
        annotation = _by_key(model)[str(part)].annotation
        model = next(kind for kind in (annotation, *get_args(annotation)) if isinstance(kind, type) and issubclass(kind, BaseModel))
    return _by_key(model)


def _by_key(model: type[BaseModel]) -> dict[str, FieldInfo]:
    return {field.alias or name: field for name, field in model.model_fields.items()}
