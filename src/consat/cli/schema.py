"""``consat schema``: what a scenario file may hold, for editors."""

import json
from pathlib import Path

import click

from consat.cli.terminal import DONE


@click.command()
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path), metavar="FILE", help="Write it there instead of on stdout.")
def schema(out: Path | None) -> int:
    """Print the JSON Schema of scenario files, for editors.

    Keep it beside your scenarios. Editors complete and check a file whose first line is

    \b
      # yaml-language-server: $schema=consat.schema.json
    """
    from consat.scenario.json_schema import json_schema

    text = json.dumps(json_schema(), indent=2, ensure_ascii=False)
    if out is None:
        click.echo(text)
    else:
        out.write_text(f"{text}\n", encoding="utf-8")
    return DONE
