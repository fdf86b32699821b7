"""What the pages of docs/reference, docs/examples.md and docs/contributing.md are made of while the site is built.

Options are read off click, keys of a scenario off its JSON Schema, so that no page has a list of its own.

    python tools/reference.py    write docs/reference/consat.schema.json
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from consat.cli.commands import cli
from consat.cli.examples import EXAMPLES
from consat.scenario.json_schema import json_schema
from consat.scenario.schema import MEMBER_KEYS

ROOT = Path(__file__).resolve().parent.parent
SCHEMA = ROOT / "docs" / "reference" / "consat.schema.json"


def schema_text() -> str:
    """The published JSON Schema, as a file has it."""
    return json.dumps(json_schema(), indent=2, ensure_ascii=False) + "\n"


def commands() -> str:
    """Every command with its usage, its options and its examples, as Markdown."""
    return "\n\n".join(part for name in sorted(cli.commands) for part in _command(name, cli.commands[name]))


def _command(name: str, command: click.Command) -> Iterator[str]:
    context = click.Context(command, info_name=f"consat {name}")
    yield f"## consat {name}"
    yield re.sub(r"\x08\n((?:  .*\n?)+)", r"\n```text\n\1```\n", command.help or "").strip()
    yield f"```text\n{command.get_usage(context).removeprefix('Usage: ')}\n```"
    rows = [option.get_help_record(context) for option in command.params if isinstance(option, click.Option)]
    yield "\n".join(["| option | says |", "|---|---|", *(f"| {_code(row[0])} | {_cell(row[1])} |" for row in rows if row is not None)])
    yield "```sh\n" + "\n".join(EXAMPLES[name]) + "\n```"


def keys() -> str:
    """Every key of a scenario file, as Markdown."""
    return "\n\n".join(_keys(json_schema()))


def _keys(schema: Mapping[str, Any]) -> Iterator[str]:
    named = schema["$defs"]
    agent, group = schema["properties"]["agents"]["items"]["anyOf"]
    yield "## The file"
    yield _table(schema)
    yield "## An agent"
    yield _table(agent)
    yield "## A group"
    yield _table(group)
    for title, prefix in (("A constraint", "constraint-"), ("A robot", "robot-"), ("An obstacle", "obstacle-")):
        yield f"## {title}"
        for name, each in named.items():
            if name.startswith(prefix):
                yield f"### {name.removeprefix(prefix)} {{ #{name} }}"
                yield html.escape(each["description"], quote=False)
                yield _table(each)
        if prefix == "constraint-":
            member = named["member-constraint-expr"]["properties"]
            yield "### of a group"
            yield "It has the keys of its kind, and may say who has it and whom it reads. A vector may be `place`, the member's own."
            yield _table({"properties": {key: member[key] for key in MEMBER_KEYS}})
    for title, name in (
        ("A schedule", "schedule"),
        ("Start", "Start"),
        ("Protocol", "ProtocolSettings"),
        ("Smoothing", "Smoothing"),
        ("A ramp", "Ramp"),
    ):
        yield f"## {title} {{ #{name.lower()} }}"
        yield _table(named[name])


def _table(schema: Mapping[str, Any]) -> str:
    needed = schema.get("required", ())
    rows = [
        f"| `{key}`{' (needed)' if key in needed else ''} | {_cell(_form(each))} | {_cell(each.get('description', ''))}{_default(each)} |"
        for key, each in schema["properties"].items()
    ]
    return "\n".join(["| key | is | says |", "|---|---|---|", *rows])


def _default(schema: Mapping[str, Any]) -> str:
    default = schema.get("default")
    return "" if default is None else f"; default `{json.dumps(default, ensure_ascii=False)}`"


def _form(schema: Mapping[str, Any]) -> str:
    """What a value is, in words."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2].removeprefix("member-")
        return f"[{name.partition('-')[2] or name.removesuffix('Settings').lower()}](#{name.lower()})"
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(_form(each) for each in schema["anyOf"] if each.get("type") != "null"))
    if "const" in schema:
        return f"`{schema['const']}`"
    if "enum" in schema:
        return " or ".join(f"`{each}`" for each in schema["enum"])
    kind = schema.get("type")
    if kind == "array":
        if "prefixItems" in schema:
            return f"list of {len(schema['prefixItems'])}"
        return "list of " + ("numbers" if schema["items"] == {"type": "number"} else _form(schema["items"]))
    if kind == "object":
        return "mapping with " + ", ".join(f"`{key}`" for key in schema["properties"]) if len(schema["properties"]) < 3 else "mapping"
    low, high = schema.get("exclusiveMinimum"), schema.get("minimum")
    words = {"integer": "whole number", "number": "number", "string": "text"}[str(kind)]
    return f"{words} > {low}" if low is not None else f"{words} ≥ {high}" if high is not None and high > -1e99 else words


def _code(text: str) -> str:
    return f"<code>{html.escape(text, quote=False).replace('|', '&#124;')}</code>"


def _cell(text: str) -> str:
    """As it is: braces would be attributes, bars would end the cell."""
    return html.escape(text, quote=False).replace("|", "&#124;").replace("{", "&#123;")


def examples() -> str:
    """The files of examples/, folded, each under the heading that links to it lead to."""
    files = sorted(file for file in (ROOT / "examples").iterdir() if file.suffix in {".yaml", ".py"})
    language = {".yaml": "yaml", ".py": "python"}
    return "\n\n".join(
        f"### {file.name} {{ #{file.name.replace('.', '-')} }}\n\n```{language[file.suffix]}\n{file.read_text(encoding='utf-8')}```"
        for file in files
    )


def page(name: str) -> str:
    """A Markdown file of the root, with links as they are from docs/."""
    return (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")


if __name__ == "__main__":
    SCHEMA.write_text(schema_text(), encoding="utf-8")
