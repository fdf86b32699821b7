"""Bad scenarios: every fault is placed, named and explained; nothing but `InvalidScenario` is ever raised, and never late."""

import copy
import json
import re
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import hypothesis
import pytest
from hypothesis import strategies as st

from consat.errors import InvalidScenario
from consat.scenario import load, loads, packaged_text, template
from consat.scenario.document import DEEPEST, LARGEST, read

BASE = """\
consat: 1
name: base
dimension: 2
agents:
  - id: a1
    start: [3, 1]
    constraints:
      - {kind: within, center: [2, 0], radius: 1, name: goal}
  - id: a2
    constraints:
      - {kind: near, agent: a1, radius: 3}
      - {kind: expr, psi: "2**2 - norm2(a2 - a1)", name: tether}
      - {kind: box, low: [-4, -4], high: [4, 4]}
communication: {links: [[a1, a2]]}
start: {box: [-4, 4], seed: 0}
protocol: {kind: gradient-flow, estimates: local, k1: 1, k2: 1}
smoothing: {nu_alpha: 5, nu_beta: {from: 0.01, to: 5, rate: 0.022}}
"""
AGENTS = BASE[BASE.index("agents:") : BASE.index("communication:")]
PSI = "2**2 - norm2(a2 - a1)"
GOAL = "agent 'a1', constraint 'goal': "
TETHER = "agent 'a2', constraint 'tether': "
POSITIVE = "must be a positive number$"


class Bad(NamedTuple):
    """`old` of `BASE`, replaced by `new`, gives exactly these lines: what follows the file's name, each a regular expression."""

    old: str
    new: str
    lines: tuple[str, ...]


def bad(old: str, new: str, *lines: str) -> Bad:
    return Bad(old, new, lines)


TOP = [
    bad("consat: 1\n", "", "1:1: consat: the version is missing"),
    bad("consat: 1", "consat:", "1:1: consat: the version is missing"),
    bad("consat: 1", "consat: 2", "1:9: consat: the scenario is of version 2, but this consat reads version 1; upgrade"),
    bad("consat: 1", "consat: one", "1:9: consat: the version is 'one', but must be 1"),
    bad("consat: 1", "consat: true", "1:9: consat: the version is True, but must be 1"),
    bad("consat: 1", "consat: 1.0", "1:9: consat: the version is 1.0, but must be 1"),
    bad("name: base", "name: 7", "2:7: name: name is 7, but must be a printable text"),
    bad("name: base", 'name: ""', "2:7: name: name is ''"),
    bad("name: base", 'name: "a\\tb"', r"2:7: name: name is 'a\\tb', but must be a printable text"),
    bad("name: base", "nmae: base", "2:1: scenario: there is no key 'nmae'; the keys are consat, name, .*; did you mean 'name'\\?"),
    bad("name: base", "1: base", "2:1: scenario: there is no key '1'"),
    bad("name: base", "colour:", "2:1: scenario: there is no key 'colour'"),
    bad("dimension: 2", "dimension: two", "3:12: dimension: dimension is 'two', but must be a whole number from 1 to 64"),
    bad("dimension: 2", "dimension: 0", "3:12: dimension: dimension is 0"),
    bad("dimension: 2", "dimension: 2.5", "3:12: dimension: dimension is 2.5"),
    bad("dimension: 2", "dimension: true", "3:12: dimension: dimension is True"),
    bad(AGENTS, "agents: []\n", "4:9: agents: a team needs at least one agent", "5:25: communication link 1: there is no agent 'a1'"),
    bad(AGENTS, "agents: [a1, a2]\n", r"4:10: agents\[0\]: it is 'a1', but must be a mapping", r"4:14: agents\[1\]: it is 'a2'"),
    bad(AGENTS, "agents: a1\n", "4:9: agents: agents is 'a1', but must be a list", "5:25: communication link 1: there is no agent"),
    bad(AGENTS, "", "1:1: agents: agents is missing", "4:25: communication link 1: there is no agent"),
]
AGENT = [
    bad("id: a2", "id: 2", r"9:9: agents\[1\]: id is 2, but must be a printable text such as 'a1'",
        r"12:27: agents\[1\], constraint 'tether': there is no agent 'a2'", "14:25: communication link 1: there is no agent 'a2'"),
    bad("id: a2", "id: a1", r"9:9: agents\[1\]: id 'a1' is taken by agents\[0\]", "11:29: .*: it names its own owner, 'a1'",
        "12:27: .*: there is no agent 'a2'", "14:25: communication link 1: there is no agent 'a2'"),
    bad("id: a2", "name: a2", r"9:5: agents\[1\]: id is missing", r"9:5: agents\[1\]: there is no key 'name'", "12:27: .*no agent 'a2'",
        "14:25: .*no agent 'a2'"),
    bad("    start: [3, 1]", "    colour: red", r"6:5: agents\[0\]: there is no key 'colour'; the keys are id, start, robot, constraints$"),
    bad("start: [3, 1]", "start: 3", "6:12: agent 'a1': start is 3, but must be a list of 2 numbers"),
    bad("start: [3, 1]", "start: [3]", "6:12: agent 'a1': start has 1 entry, but must have 2"),
    bad("start: [3, 1]", "start: [3, x]", "6:12: agent 'a1': start holds 'x'"),
    bad("start: [3, 1]", "start: [3, .nan]", "6:12: agent 'a1': start holds nan"),
    bad("start: [3, 1]", "start: {x: 3, y: 1}", "6:12: agent 'a1': start is {'x': 3, 'y': 1}, but must be a list of 2 numbers"),
    bad("- {kind: within, center: [2, 0], radius: 1, name: goal}", "- within", "8:9: agent 'a1', constraint 1: it is 'within', but"),
    bad("\n      - {kind: within, center: [2, 0], radius: 1, name: goal}", " within", "7:18: agent 'a1': constraints is 'within'"),
]  # fmt: skip
CONSTRAINT = [
    bad("kind: within", "kind: withn", "8:16: agent 'a1', constraint 1: there is no kind 'withn'; the kinds are .*; did you mean 'within'"),
    bad("kind: within", "kind: 3", "8:16: agent 'a1', constraint 1: there is no kind 3"),
    bad("kind: within, ", "", "8:9: agent 'a1', constraint 1: kind is missing; it is one of within, "),
    bad("center: [2, 0]", "center: [2, 0, 1]", f"8:32: {GOAL}center has 3 entries, but must have 2"),
    bad("center: [2, 0]", "center: 2", f"8:32: {GOAL}center is 2, but must be a list of 2 numbers"),
    bad("center: [2, 0]", "center: [2, '0']", f"8:32: {GOAL}center holds '0'"),
    bad("center: [2, 0]", "center: [2, ~]", f"8:32: {GOAL}center holds None"),
    bad("center: [2, 0], ", "", f"8:9: {GOAL}center is missing; within needs center, radius"),
    bad("center: [2, 0]", "center: ", f"8:24: {GOAL}center is missing; within needs center, radius"),
    bad(
        "center: [2, 0]",
        "centre: [2, 0]",
        f"8:9: {GOAL}center is missing",
        f"8:24: {GOAL}there is no key 'centre'; .*did you mean 'center'",
    ),
    bad("radius: 1,", "radius: -1,", f"8:48: {GOAL}radius is -1, but {POSITIVE}"),
    bad("radius: 1,", "radius: 0,", f"8:48: {GOAL}radius is 0, but {POSITIVE}"),
    bad("radius: 1,", "radius: wide,", f"8:48: {GOAL}radius is 'wide', but {POSITIVE}"),
    bad("radius: 1,", "radius: .inf,", f"8:48: {GOAL}radius is inf, but must be a positive number of size at most 1e\\+100"),
    bad("radius: 1,", "radius: .nan,", f"8:48: {GOAL}radius is nan, but {POSITIVE}"),
    bad("radius: 1,", "radius: yes,", f"8:48: {GOAL}radius is 'yes', but {POSITIVE}"),
    bad("radius: 1,", "radius: true,", f"8:48: {GOAL}radius is True, but {POSITIVE}"),
    bad("radius: 1,", "radius: 2020-01-01,", f"8:48: {GOAL}radius is '2020-01-01', but {POSITIVE}"),
    bad("radius: 1,", "radius: 1_000,", f"8:48: {GOAL}radius is '1_000', but {POSITIVE}"),
    bad("radius: 1,", f"radius: {'9' * 250},", f"8:48: {GOAL}radius is 9+…, but must be a positive number of size"),
    bad("radius: 1,", f"radius: {'9' * 5000},", f"8:48: {GOAL}radius is inf"),
    bad("radius: 1,", "radius: [1],", rf"8:48: {GOAL}radius is \[1\], but {POSITIVE}"),
    bad("radius: 1,", "radius: 1, weight: 0,", f"8:59: {GOAL}weight is 0, but {POSITIVE}"),
    bad("radius: 1,", "radius: 1, colour: red,", f"8:51: {GOAL}there is no key 'colour'; the keys are kind, center, radius, name, weight"),
    bad("radius: 1,", "radius: 1, <<: {weight: 2},", f"8:51: {GOAL}there is no key '<<'"),
    bad("radius: 1,", "radius: 1, radius: 2,", "8:51: YAML: the key 'radius' stands here for the second time"),
    bad("name: goal", "name: 5", "8:57: agent 'a1', constraint 'within': name is 5, but must be text; put numbers in quotes"),
    bad("name: goal", "name: ''", "8:57: agent 'a1': name is '', but must be a printable text"),
    bad("name: tether", 'name: "box.low[0]"', r"13:9: agent 'a2': name 'box.low\[0\]' is taken"),
    bad("agent: a1", "agent: ghost", r"11:29: agent 'a2', constraint 'near\(ghost\)': there is no agent 'ghost'$"),
    bad("agent: a1", "agent: A1", r"11:29: .*: there is no agent 'A1'; did you mean 'a1'\?"),
    bad("agent: a1", "agent: a2", "11:29: agent 'a2', constraint 'near': it names its own owner, 'a2'; name another agent"),
    bad("agent: a1", "agent: 1", "11:29: agent 'a2', constraint 'near': agent is 1, but must be text"),
    bad("agent: a1", "agent: [a1]", r"11:29: agent 'a2', constraint 'near': agent is \['a1'\], but must be text"),
    bad("low: [-4, -4]", "low: [5, -4]", r"13:41: agent 'a2', .*high is \[4.0, 4.0\], but must be above low \[5.0, -4.0\]"),
    bad("low: [-4, -4]", "low: []", "13:26: agent 'a2', .*low has 0 entries"),
    bad("low: [-4, -4]", "low: [1, [2]]", r"13:26: agent 'a2', .*low holds \[2\]"),
    bad("low: [-4, -4]", f"low: {[0] * 5000}", "13:26: agent 'a2', .*low has 5,000 entries"),
    bad("low: [-4, -4], ", "", "13:9: agent 'a2', constraint 'box': low is missing; box needs low, high"),
]
EXPRESSION = [
    bad(PSI, "__import__('os').getcwd()", f"12:27: {TETHER}"),
    bad(PSI, "2**2 - norm2(a2 - ghost)", f"12:27: {TETHER}there is no agent 'ghost'"),
    bad(PSI, "2**2 - norm2(a1)", f"12:27: {TETHER}it must read the position of its owner 'a2', but reads 'a1'"),
    bad(PSI, "4", f"12:27: {TETHER}the expression reads no agent"),
    bad(PSI, "", f"12:27: {TETHER}the expression is empty"),
    bad(PSI, "4 - nrom2(a2)", f"12:32: {TETHER}unknown function 'nrom2'; did you mean norm2"),
    bad(PSI, "1 + a2", f"12:3[12]: {TETHER}.*vector"),  # seen only when the family is traced
    bad(f'"{PSI}"', "4 - abs(a2.x)", f"12:31: {TETHER}abs has no gradient"),  # no quote to skip
    bad(f'"{PSI}"', "'4 - abs(a2.x)'", f"12:32: {TETHER}abs has no gradient"),
    bad(f'"{PSI}"', '"4 - \\x61bs(a2.x)"', f"12:27: {TETHER}abs has no gradient"),  # columns do not correspond
    bad(f'"{PSI}"', "4 -\n         abs(a2.x)", f"12:27: {TETHER}abs has no gradient"),
    bad(f'"{PSI}"', "4", f"12:27: {TETHER}psi is 4, but must be text"),
    bad(f'psi: "{PSI}", ', "", f"12:9: {TETHER}psi is missing"),
]
COMMUNICATION = [
    bad("{links: [[a1, a2]]}", "ring", "14:16: communication: communication is 'ring', but must be a mapping such as .*{graph: ring}"),
    bad("links: [[a1, a2]]", "graph: ringg", "14:24: communication: there is no graph 'ringg'; choose one of line, ring, "),
    bad("links: [[a1, a2]]", "graph: 3", "14:24: communication.graph: graph is 3, but must be a word"),
    bad("links: [[a1, a2]]", "links: [[a1, a2]], graph: ring", "14:16: communication: communication has both"),
    bad("links: [[a1, a2]]", "", "14:16: communication: communication has neither"),
    bad("links: [[a1, a2]]", "link: []", "14:16: .* has neither", "14:17: communication: there is no key 'link'; .*did you mean 'links'"),
    bad("[[a1, a2]]", "a1", "14:24: communication.links: links is 'a1', but must be a list of pairs"),
    bad("[[a1, a2]]", "[a1, a2]", "14:25: communication link 1: a link joins two agents, .* but is 'a1'", "14:29: communication link 2: "),
    bad("[[a1, a2]]", "[[a1, a1]]", "14:25: communication link 1: agent 'a1' is linked to itself"),
    bad("[[a1, a2]]", "[[a1, a2], [a2, ghost]]", "14:35: communication link 2: there is no agent 'ghost'"),
    bad("[[a1, a2]]", "[[a1, [a2]]]", r"14:25: communication link 1: there is no agent \['a2'\]"),
    bad("[[a1, a2]]", "[[a1, a2, a1]]", "14:25: communication link 1: a link joins two agents"),
]
RUN = [
    bad("start: {box: [-4, 4], seed: 0}", "start: 5", r"15:8: start: start is 5, but must be a mapping such as {box: \[-4, 4\], seed: 0}"),
    bad("seed: 0", "sed: 0", "15:23: start: there is no key 'sed'; the keys are box, seed; did you mean 'seed'"),
    bad("box: [-4, 4]", "box: [4, -4]", r"15:14: start: box is \[4.0, -4.0\], but must be \[low, high\] with low ≤ high"),
    bad("box: [-4, 4]", "box: [4]", r"15:14: start: box is \[4\], but must be \[low, high\]"),
    bad("box: [-4, 4]", "box: ['-4', 4]", r"15:14: start: box is \['-4', 4\], but must be \[low, high\]"),
    bad("box: [-4, 4]", "box: [[-4, -4, -4], [4, 4, 4]]", "15:14: start: a side of the box has 3 entries, but must have 2"),
    bad("box: [-4, 4]", "box: [-.inf, .inf]", r"15:14: start: box is \[-inf, inf\]"),
    bad("seed: 0", "seed: 1.5", "15:29: start: seed is 1.5, but must be a whole number from 0"),
    bad("seed: 0", "seed: -1", "15:29: start: seed is -1, but must be a whole number from 0"),
    bad("seed: 0", f"seed: {2**63}", f"15:29: start: seed is {2**63}, but must be a whole number from 0"),
    bad("seed: 0", "seed: true", "15:29: start: seed is True, but must be a whole number from 0"),
    bad("gradient-flow", "gradient-flo", "16:18: protocol: kind is 'gradient-flo', but must be one of .*; did you mean 'gradient-flow'"),
    bad("estimates: local", "estimates: all", "16:44: protocol: estimates is 'all', but must be local or full"),
    bad("k1: 1", "k1: -1", f"16:55: protocol: k1 is -1, but {POSITIVE}"),
    bad("k1: 1", "k3: 1", "16:51: protocol: there is no key 'k3'; the keys are kind, estimates, k1, k2"),
    bad(BASE[BASE.index("smoothing:") :], "smoothing: atuo\n", "17:12: smoothing: smoothing is 'atuo', but must be auto, or a mapping"),
    bad("nu_alpha: 5, ", "", "17:12: smoothing: nu_alpha is missing; it must be a positive number"),
    bad("nu_alpha: 5", "nu_alpha: .nan", f"17:23: smoothing: nu_alpha is nan, but {POSITIVE}"),
    bad(
        "{from: 0.01, to: 5, rate: 0.022}", "fast", "17:35: smoothing: nu_beta is 'fast', but must be a positive number, or a ramp such as"
    ),
    bad("to: 5", "to: 0.001", "17:35: smoothing: the ramp goes from 0.01 to 0.001, but must not fall"),
    bad("rate: 0.022", "rate: fast", f"17:61: smoothing.nu_beta: rate is 'fast', but {POSITIVE}"),
    bad("from: 0.01", "start: 0.01", "17:35: smoothing.nu_beta: from is missing", "17:36: smoothing.nu_beta: there is no key 'start'"),
]
SYNTAX = [
    bad("name: base", "name: &x base", r"2:7: YAML: anchors \(&\) and aliases"),
    bad("name: base", "name: *x", r"2:7: YAML: anchors \(&\) and aliases"),
    bad("name: base", "name: !!str base", r"2:7: YAML: tags \(!\) are not part of a scenario"),
    bad("name: base", "name: !!python/object/apply:os.system [ls]", r"2:7: YAML: tags \(!\) are not part of a scenario"),
    bad("name: base", "name: base\nname: base", "3:1: YAML: the key 'name' stands here for the second time"),
    bad("name: base", "? [a]\n: b", "2:3: YAML: a key must be plain text"),
    bad("name: base", "name: base: x", "2:11: YAML: a ':' stands where no key can be"),
    bad("name: base", "name: @base", "2:7: YAML: a text that starts with @ must stand in quotes"),
    bad("name: base", "\tname: base", "2:1: YAML: a tab stands here; indent and separate with spaces"),
    bad("name: base", "name: 'base", "2:7: YAML: a quote is opened, but never closed"),
    bad("name: base", 'name: "\\q"', "2:9: YAML: .q means nothing within double quotes"),
    bad("name: base", 'name: "\\UFFFFFFFF"', "2:1: YAML: .* names no character"),
    bad("name: base", "name: a\x07b", r"2:8: YAML: there is a character U\+0007"),
    bad("name: base", "name: \ud800", r"2:7: YAML: there is a character U\+D800"),
    bad("name: base", "name: base\n---\na: 1", "3:1: YAML: a second document starts here"),
    bad("consat: 1", "%YAML 1.1\n---\nconsat: 1", "2:1: YAML: the %YAML line asks for another version"),
    bad("    start: [3, 1]", "   start: [3, 1]", "6:4: YAML: the indentation does not fit the lines above"),
    bad("[[a1, a2]]}", "[[a1, a2]}", r"14:33: YAML: a comma between entries or the closing \] is missing"),
    bad("[[a1, a2]]}", "[[a1, a2]]}}", "14:35: YAML: there is one } too many"),
    bad("0.022}}", "0.022}", "17:12: YAML: a comma between entries or the closing } is missing"),
]
TABLE = TOP + AGENT + CONSTRAINT + EXPRESSION + COMMUNICATION + RUN + SYNTAX


def complaint(text: str) -> str:
    with pytest.raises(InvalidScenario) as caught:
        loads(text, "s.yaml")
    return str(caught.value)


def test_base_is_valid() -> None:
    assert loads(BASE).team.count == 2


def test_table_is_large() -> None:
    assert len({(case.old, case.new) for case in TABLE}) == len(TABLE) >= 60


@pytest.mark.parametrize("case", TABLE, ids=lambda case: f"{case.old[:20]}->{case.new[:40]}".encode("ascii", "replace").decode())
def test_fault_is_placed_and_explained(case: Bad) -> None:
    assert BASE.count(case.old) >= 1
    lines = complaint(BASE.replace(case.old, case.new, 1)).split("\n")
    assert len(lines) == len(case.lines), lines
    for line, expected in zip(lines, case.lines, strict=True):
        assert re.match(f"s.yaml:{expected}", line), line


@pytest.mark.parametrize("text", ["", "\n", "# nothing\n", "---\n", "~", "- 1\n", "consat\n", "3", "[]"])
def test_no_mapping(text: str) -> None:
    assert re.fullmatch(r"s\.yaml:\d+:1: scenario: the file (is empty|holds .*), but must hold keys and values, .*", complaint(text))


def test_all_faults_at_once_in_the_order_of_the_file() -> None:
    text = BASE
    for old, new in (
        ("start: [3, 1]", "start: [3]"), ("radius: 1,", "radius: -1, colour: red,"), ("radius: 3", "radius: 3, radius: 4"),
        (PSI, "abs(a2.x)"), ("[[a1, a2]]", "[[a1, ghost]]"), ("seed: 0", "seed: x"), ("nu_alpha: 5", "nu_alpha: 0"),
        ("name: base", "nam: base"),
    ):  # fmt: skip
        text = text.replace(old, new, 1)
    lines = complaint(text).split("\n")
    assert [line.split(": ")[0] for line in lines] == [
        f"s.yaml:{place}" for place in ("2:1", "6:12", "8:48", "8:52", "11:44", "12:27", "14:25", "15:29", "17:23")
    ]


def test_many_faults_stay_quick() -> None:
    agents = "".join(
        f"  - {{id: a{i}, constraints: [{{kind: near, agent: b{i}, radius: 0}}, {{kind: expr, psi: a{i}}}]}}\n" for i in range(300)
    )
    begin = time.process_time()
    assert complaint(f"consat: 1\nagents:\n{agents}").count("\n") == 899
    assert time.process_time() - begin < 20  # about 1 s; looking for similar ids for each would take minutes


HOSTILE = {
    "billion laughs": "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 30)),
    "alias of itself": "a: &a [*a]",
    "deep lists": "[" * 1_000_000,
    "deep mappings": "{a: " * 200_000,
    "deep blocks": "- " * 200_000,
    "deep keys": "? " * 200_000,
    "brackets as keys": "{" * 200_000,
    "long digits": f"a: {'9' * 100_000}",
    "long hexadecimal": f"a: 0x{'F' * 100_000}",
    "long float": f"a: 1{'0' * 100_000}.5e-99999",
    "long tag": f"a: !{'x' * 50_000}",
    "long psi": BASE.replace(PSI, "(" * 100_000),
    "many documents": "--- 1\n" * 20_000,
    "colons": ":" * 50_000,
    "too large": " " * LARGEST + BASE,
}


@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE.keys())
def test_hostile_file_is_refused_in_a_blink(text: str, tmp_path: Any) -> None:
    file = tmp_path / "s.yaml"
    file.write_text(text)
    begin = time.process_time()
    with pytest.raises(InvalidScenario, match=r"s\.yaml:\d+:\d+: "):
        load(file)
    assert time.process_time() - begin < 5  # a fraction of a second, and slow machines


def test_depth_has_a_limit() -> None:
    assert f"nested deeper than {DEEPEST} levels" in complaint("[" * (DEEPEST + 1))


@pytest.mark.parametrize(
    ("content", "place"), [(b"\xff\xfe\0", "1:1"), (b"consat: 1\nname: \xe4\n", "2:7"), (b"\xef\xbb\xbfa: \xc3\xa4\xff", "1:5")]
)
def test_file_is_utf8(content: bytes, place: str, tmp_path: Any) -> None:
    file = tmp_path / "s.yaml"
    file.write_bytes(content)
    with pytest.raises(InvalidScenario, match=rf"s\.yaml:{place}: YAML: there is a byte that is no UTF-8"):
        load(file)


# Fuzz: whatever a file holds, loading it works or raises InvalidScenario with placed lines, and quickly.

TEXTS = [BASE, packaged_text("case-e"), packaged_text("example-1"), template()]
TREES = [root.plain for text in TEXTS if (root := read(text, "s.yaml").root)]
PIECES = [
    *"[]{}:,-#&*!|>'\"%@`?~<=\\/\t\n\r 019.eE+axé\x85\u2028\ufeff_()\x00\x07", "", "", "\n---\n", "\n...\n", "<<: ", "- ", "? ", "&a ",
    "*a ", "**", "!!python/name:os.system ", ".nan", "-.inf", "0x", "1e999", "true", "null", "9" * 400, '"\\U', '"\\x', "|\n", ">-\n",
    "@owner", "__class__", "a1",
]  # fmt: skip
JUNK = [
    None, True, 0, -1, 0.5, 1e308, 10**30, float("nan"), float("inf"), "", "x", "a1", "@owner", "norm2(a1)", "é", "\x85", "a\nb",
    "9" * 400, "auto", "expr", "box", "near", [], {}, [[]], [{}], [None], {"a": 1}, {"kind": "within"}, [1, 2], [1, 2, 3], [[1], [2]],
    [1] * 70, ["a1", "a2"],
]  # fmt: skip


@st.composite
def scrawled(draw: st.DrawFn) -> str:
    """A valid text with a few places overwritten."""
    text = draw(st.sampled_from(TEXTS))
    for place, cut, piece in draw(
        st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 6), st.sampled_from(PIECES)), min_size=1, max_size=5)
    ):
        at = place % (len(text) + 1)
        text = text[:at] + piece + text[at + cut :]
    return text


def paths(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from paths(value, (*path, key))


@st.composite
def twisted(draw: st.DrawFn) -> str:
    """A valid structure with a few values replaced, removed, wrapped, renamed or repeated."""
    data = copy.deepcopy(draw(st.sampled_from(TREES)))
    for _ in range(draw(st.integers(1, 4))):
        *parents, last = draw(st.sampled_from(list(paths(data)) or [("consat",)]))
        parent = data
        for key in parents:
            parent = parent[key]
        junk = copy.deepcopy(draw(st.sampled_from(JUNK)))
        match draw(st.sampled_from(["replace", "replace", "remove", "wrap", "rename", "repeat"])):
            case "replace":
                parent[last] = junk
            case "remove" if last in parent or isinstance(parent, list):
                del parent[last]
            case "wrap":
                parent[last] = (
                    draw(st.sampled_from([[parent.get(last)], {"id": parent.get(last)}])) if isinstance(parent, dict) else [parent[last]]
                )
            case "rename" if isinstance(parent, dict):
                parent[str(junk)] = parent.pop(last, None)
            case _ if isinstance(parent, list):
                parent.append(copy.deepcopy(parent[last]))
    return json.dumps(data).replace("NaN", ".nan").replace("Infinity", ".inf")


def survives(text: str) -> None:
    begin = time.process_time()
    try:
        loads(text, "FILE")
    except InvalidScenario as error:
        message = str(error)
        assert all(re.match(r"FILE:\d+(:\d+)?: \S.*: \S", line) for line in message.split("\n")), message
        assert not re.search("pydantic|Input should|JAX", message), message
    assert time.process_time() - begin < 5  # milliseconds, but for a compilation or the garbage collector


@hypothesis.settings(max_examples=600, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(scrawled())
def test_scrawled_text_is_read_or_refused(text: str) -> None:
    survives(text)


@hypothesis.settings(max_examples=600, suppress_health_check=list(hypothesis.HealthCheck))
@hypothesis.given(twisted())
def test_twisted_structure_is_read_or_refused(text: str) -> None:
    survives(text)
