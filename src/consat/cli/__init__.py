"""The command line: parses arguments and prints results, without computations.

`commands` has the commands of a single process, `network` those of agents on a network.
"""

from consat.cli.commands import main

__all__ = ["main"]
