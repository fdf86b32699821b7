"""Examples at the end of the ``--help`` of each command."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import click

EXAMPLES: Final[Mapping[str, tuple[str, ...]]] = {
    "agent": ("consat agent case-b --id a1", "consat agent parts/a1.yaml --id a1 --sensor stdin --speed 0.5"),
    "animate": ("consat animate runs/case-b", "consat animate runs/case-b --out film.mp4"),
    "check": ("consat check my-team.yaml", "consat check case-e --json"),
    "doctor": ("consat doctor", "consat doctor --json"),
    "export": ("consat export runs/case-b --to run.csv", "consat export runs/case-b --to run.mcap"),
    "init": ("consat init my-team.yaml", "consat init case-b"),
    "keys": ("consat keys case-b --out keys", "consat keys a1 a2 --out keys --address 192.168.0.7"),
    "launch": ("consat launch case-b --rounds 200", "consat launch case-b --loss 0.1 --delay 0.02,0.05 --out runs/case-b"),
    "live": ("consat live case-b", "consat live my-team.yaml --no-open --port 8000"),
    "plot": ("consat plot runs/case-b", "consat plot runs/case-b --out figures"),
    "run": (
        "consat run case-b",
        "consat run my-team.yaml --seed 3 --out runs/my-team",
        "consat run case-c --protocol gradient-flow --estimates full --until 300",
        "consat run swarm --set count=1000 --json",
    ),
    "schema": ("consat schema --out consat.schema.json",),
    "show": ("consat show runs/case-b", "consat show runs/case-b --out page.html"),
    "solve": ("consat solve case-c", "consat solve my-team.yaml --set agents.a1.constraints.0.radius=2 --json"),
    "split": ("consat split case-b --out parts", "consat split case-b --out parts --address a2=tcp/192.168.0.7:7447"),
    "sweep": ("consat sweep case-b --seeds 100", "consat sweep case-b --over loss=0,0.1,0.3 --seeds 20 --out runs/loss"),
}
"""For each command its examples."""


def add_examples(group: click.Group) -> None:
    """Add its examples, unwrapped, to the end of the help of every command of the group."""
    for name, lines in EXAMPLES.items():
        if name in group.commands:
            group.commands[name].epilog = "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)
