"""The command line: words in and words out, no mathematics. `commands` has those of one process, `network` those of many."""

from consat.cli.commands import main

__all__ = ["main"]
