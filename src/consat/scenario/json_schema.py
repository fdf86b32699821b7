"""The JSON Schema of a scenario file, for editors: made from the keys that the loader reads, so it has no list of its own.

What it cannot say (that an id is known, that a link joins clusters, how an expression is written) only `consat.scenario.load` can.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from consat.problem.agent import Agent
from consat.problem.constraints import KINDS
from consat.problem.groups import ACROSS, MOST, PLACE, SHAPES, Group
from consat.problem.links import TOPOLOGIES
from consat.problem.schedule import KEYS as SCHEDULE_KEYS
from consat.problem.team import LONGEST_UNIT
from consat.scenario.mappings import TEXT, parameters, required
from consat.scenario.schema import AGENT_KEYS, GROUP_KEYS, KEYS, MEMBER_KEYS, VERSION
from consat.settings import Settings

Json = dict[str, Any]

TEXTUAL: Final[Json] = {"type": "string", "minLength": 1}
POSITIVE: Final[Json] = {"type": "number", "exclusiveMinimum": 0}
NUMBERS: Final[Json] = {"type": "array", "items": {"type": "number"}, "minItems": 1}
COUNT: Final[Json] = {"type": "integer", "minimum": 1, "maximum": MOST}


def json_schema() -> Json:
    """The schema of a scenario file, JSON Schema 2020-12.

    Returns:
        a document for `json.dumps`; under ``$defs`` each kind of constraint, robot and obstacle is described on its own.
    """
    from consat.scenario.robots import KINDS as ROBOTS
    from consat.scenario.robots import SHAPES as OBSTACLES

    settings = Settings.model_json_schema(by_alias=True, ref_template="#/$defs/{model}")
    kinds = {f"constraint-{kind}": _constraint(kind, factory) for kind, factory in KINDS.items()}
    members = {f"member-constraint-{kind}": _constraint(kind, factory, grouped=True) for kind, factory in KINDS.items()}
    robots = {f"robot-{kind}": _made(kind, model, kind_needed=False) for kind, model in ROBOTS.items()}
    obstacles = {f"obstacle-{kind}": _made(kind, shape) for kind, shape in OBSTACLES.items()}
    robot = {"anyOf": _references(robots)}
    agent = {
        "id": TEXTUAL,
        "start": NUMBERS,
        "robot": robot,
        "constraints": {"type": "array", "items": {"anyOf": _references(kinds)}},
    }
    group = {
        "group": TEXTUAL,
        "count": COUNT,
        "shape": {"enum": list(SHAPES)},
        "spacing": POSITIVE,
        "scatter": {"type": "number", "minimum": 0},
        "seed": {"type": "integer", "minimum": 0},
        "constraints": {"type": "array", "items": {"anyOf": _references(members)}},
    }
    private = {"constraints": "each holds where its ψ is positive"}
    about_agent = (
        _arguments(Agent)
        | private
        | {"start": "where it stands at first, d numbers", "robot": "limits of its own; the others as in robots"}
    )
    about_group = _arguments(Group) | private | {"group": _arguments(Group)["name"], "scatter": "how far from its place a member starts"}
    whole = {
        "consat": {"const": VERSION, "description": "the version of the format"},
        "name": TEXTUAL | {"description": "of the scenario, in reports and figures"},
        "dimension": {"type": "integer", "minimum": 1, "maximum": 64, "default": 2, "description": "d of the space, R^d"},
        "unit": TEXTUAL | {"maxLength": LONGEST_UNIT, "description": "of lengths, such as m, for figures and exports"},
        "count": COUNT | {"description": "how many members a group has that doesn't say it itself; --set count=N changes it"},
        "agents": {
            "type": "array",
            "minItems": 1,
            "items": {
                "anyOf": [
                    _object(agent, AGENT_KEYS, ("id",), about_agent),
                    _object(group, GROUP_KEYS, ("group",), about_group),
                ]
            },
            "description": "agents, and groups that stand for many",
        },
        "communication": {
            "anyOf": [
                {"type": "object", "properties": {"links": {"type": "array", "items": {"type": "array", "items": TEXTUAL}}}},
                {"type": "object", "properties": {"graph": {"enum": list(TOPOLOGIES)}}},
            ],
            "description": "who talks to whom: links, pairs of ids, or graph; left out, along the constraints (task)",
        },
        "robots": robot | {"required": ["kind"], "description": "what bodies are; left out, points that are where they want to be"},
        "obstacles": {"type": "array", "items": {"anyOf": _references(obstacles)}, "description": "what robots keep clear of"},
        "rate": POSITIVE | {"description": "rounds a second, Hz"},
        **{key: {name: value for name, value in each.items() if name != "default"} for key, each in settings["properties"].items()},
    }
    for form in whole["communication"]["anyOf"]:
        form |= {"required": list(form["properties"]), "additionalProperties": False}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "consat scenario",
        **_object(whole, KEYS, ("consat", "agents"), {}),
        "$defs": {
            "schedule": _schedule(),
            **kinds,
            **members,
            **robots,
            **obstacles,
            **settings["$defs"],
        },
    }


def _object(properties: Mapping[str, Json], keys: Sequence[str], required: Sequence[str], about: Mapping[str, str]) -> Json:
    """A mapping with the keys that the loader reads, each described where `about` tells of it."""
    described = {key: properties[key] | ({"description": about[key]} if key in about else {}) for key in keys}
    return {"type": "object", "properties": described, "required": list(required), "additionalProperties": False}


def _references(definitions: Mapping[str, Json]) -> list[Json]:
    return [{"$ref": f"#/$defs/{name}"} for name in definitions]


def _schedule() -> Json:
    values = {"type": "array", "minItems": 1, "items": {"anyOf": [{"type": "number"}, NUMBERS]}}
    about = {"times": "s, rising", "values": "one for each time; linear between, held before and after"}
    return _object(dict(zip(SCHEDULE_KEYS, (NUMBERS, values), strict=True)), SCHEDULE_KEYS, SCHEDULE_KEYS, about)


def _constraint(kind: str, factory: Callable[..., Any], *, grouped: bool = False) -> Json:
    """A kind of constraint; of a group also who has it, and whom it reads."""
    properties = {"kind": {"const": kind}} | {name: _parameter(name, each, grouped=grouped) for name, each in parameters(factory).items()}
    about = _arguments(factory)
    if grouped:
        properties |= {"of": _whose(), "agent": _relation()}
        about |= {"of": "who has it; left out, every member", "agent": "whom it reads: an id, or a step such as -1 for the one ahead"}
    keys = ["kind", *parameters(factory)]
    if grouped:
        keys += [key for key in (MEMBER_KEYS if kind == "expr" else MEMBER_KEYS[:1]) if key not in keys]
    return {"description": _first(factory)} | _object(properties, keys, ["kind", *required(factory)], about)


def _parameter(name: str, parameter: inspect.Parameter, *, grouped: bool) -> Json:
    """What the loader takes for a parameter of a constraint, by its annotation."""
    if name == "agent" or parameter.annotation in TEXT:
        return TEXTUAL
    if name == "weight":
        return POSITIVE
    plain: Json = {"type": "number"} if parameter.annotation == "float" else NUMBERS
    places = [{"enum": [PLACE, ACROSS]}] if grouped and plain is NUMBERS else []
    return {"anyOf": [plain, {"$ref": "#/$defs/schedule"}, *places]}


def _whose() -> Json:
    return {"anyOf": [TEXTUAL, _only("every"), {"type": "array", "items": TEXTUAL}]}


def _relation() -> Json:
    return {"anyOf": [TEXTUAL, {"type": "integer"}, {"type": "array", "items": {"type": "integer"}}, _only("nearest")]}


def _only(key: str) -> Json:
    """A mapping with this one key, a count."""
    return _object({key: COUNT}, (key,), (key,), {})


def _made(kind: str, factory: Callable[..., Any], *, kind_needed: bool = True) -> Json:
    """A robot or an obstacle: numbers, or lists of them."""
    shapes: Mapping[str, Json] = {
        "Number": {"anyOf": [POSITIVE, NUMBERS]},
        "float": POSITIVE,
        "Sequence[float]": NUMBERS,
        "Sequence[Sequence[float]]": {"type": "array", "items": NUMBERS, "minItems": 3},
    }
    properties: dict[str, Json] = {"kind": {"const": kind}}
    for name, each in parameters(factory).items():
        properties[name] = shapes[str(each.annotation)] | ({} if each.default is each.empty else {"default": each.default})
    needed = ["kind", *required(factory)] if kind_needed else []
    return {"description": _first(factory)} | _object(properties, list(properties), needed, _arguments(factory))


def _first(factory: Callable[..., Any]) -> str:
    """The first line of what it says of itself."""
    return (inspect.getdoc(factory) or "").partition("\n")[0]


def _arguments(factory: Callable[..., Any]) -> dict[str, str]:
    """What the docstring says of each argument (Google style)."""
    _, _, listed = re.split(r"^(Args|Attributes):\n", inspect.getdoc(factory) or "", maxsplit=1, flags=re.MULTILINE)
    section = re.split(r"^\S", listed, maxsplit=1, flags=re.MULTILINE)[0]
    items = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, flags=re.MULTILINE)
    return {name: re.sub(r"\s+", " ", text).strip().rstrip(".").replace("``", "") for name, text in items}
