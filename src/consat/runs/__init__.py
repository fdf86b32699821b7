"""User-level functions, from a scenario to a result: `run` and `resume`, `solve`, `sweep` over many runs, and `Session`.

Start reading at `runner`. `preparation` prepares a team and `summary` reports how it ended, for all of them and for agents on a network.
"""
