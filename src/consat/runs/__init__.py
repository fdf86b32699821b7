"""What a user calls, from a scenario to a result: `run` and `resume`, `solve`, and `sweep` over many runs.

Begin with `runner`. `preparation` makes a team ready and `summary` tells how it ended, for every one of them and for agents on a network.
"""
