"""The JSON Schema takes what the loader takes, and refuses what it refuses for its keys and types."""

import copy
import json
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from ruamel.yaml import YAML

import consat as cs
from consat.cli.commands import cli
from consat.scenario import packaged, packaged_text, template
from consat.scenario.json_schema import json_schema

jsonschema = pytest.importorskip("jsonschema", reason="needs jsonschema, which the extra test installs")
EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.yaml"))
TEXTS = {name: packaged_text(name) for name in packaged()} | {file.name: file.read_text(encoding="utf-8") for file in EXAMPLES}
GOOD: dict[str, Any] = {
    "consat": 1,
    "agents": [
        {"id": "a", "start": [0, 0], "robot": {"speed": 1}, "constraints": [{"kind": "within", "center": [1, 0], "radius": 1}]},
        {"group": "g", "count": 3, "constraints": [{"kind": "expr", "agent": -1, "of": "first", "psi": "1 - norm2(self - other)"}]},
    ],
    "robots": {"kind": "unicycle", "radius": 0.1},
    "obstacles": [{"kind": "box", "low": [3, 3], "high": [4, 4]}],
}
BAD: dict[str, tuple[tuple[Any, ...], Any]] = {
    "another version": (("consat",), 2),
    "a key that is none": (("color",), "red"),
    "a key of a constraint that is none": (("agents", 0, "constraints", 0, "centre"), [0, 0]),
    "a kind that is none": (("agents", 0, "constraints", 0, "kind"), "inside"),
    "text for a number": (("agents", 0, "constraints", 0, "radius"), "wide"),
    "a place outside a group": (("agents", 0, "constraints", 0, "center"), "place"),
    "a graph that is none": (("communication",), {"graph": "web"}),
    "links and a graph": (("communication",), {"graph": "ring", "links": [["a", "g1"]]}),
    "a robot without a kind": (("robots",), {"radius": 0.1}),
    "a protocol that is none": (("protocol",), {"kind": "gossip"}),
    "a polygon of two points": (("obstacles",), [{"kind": "polygon", "vertices": [[0, 0], [1, 1]]}]),
    "a ramp that lacks its end": (("smoothing",), {"nu_alpha": 5, "nu_beta": {"from": 0.01, "rate": 1}}),
}


def faults(scenario: Any) -> list[str]:
    return [error.message for error in jsonschema.Draft202012Validator(json_schema()).iter_errors(scenario)]


def test_it_is_a_schema_and_the_command_prints_it() -> None:
    jsonschema.Draft202012Validator.check_schema(json_schema())
    assert json.loads(CliRunner().invoke(cli, ["schema"], standalone_mode=False).output) == json_schema()


@pytest.mark.parametrize("text", [*TEXTS.values(), template()], ids=[*TEXTS, "template"])
def test_what_the_package_ships_is_valid(text: str) -> None:
    assert faults(YAML(typ="safe", pure=True).load(text)) == []


@pytest.mark.parametrize(("path", "value"), BAD.values(), ids=BAD)
def test_what_the_loader_refuses_is_not_valid(path: tuple[Any, ...], value: Any) -> None:
    assert faults(GOOD) == []
    cs.loads(json.dumps(GOOD))
    changed = copy.deepcopy(GOOD)
    place = changed
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    assert faults(changed)
    with pytest.raises(cs.InvalidScenario):
        cs.loads(json.dumps(changed))


def test_every_key_is_described() -> None:
    schema = json_schema()
    objects = [schema, *schema["properties"]["agents"]["items"]["anyOf"]]
    objects += [each for name, each in schema["$defs"].items() if "-" in name]
    undescribed = [key for each in objects for key, about in each["properties"].items() if key != "kind" and not about.get("description")]
    assert undescribed == []
