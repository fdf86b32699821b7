"""User-level functions, from a scenario to a result: `run` and `resume`, `solve`, `sweep` over many runs, and `Session`.

Start reading at `runner`. A run and a session advance the same `consat.engine.simulation`, a run until a rule ends it, a session when it is
asked to. `preparation` prepares a team and `summary` reports how it ended, for all of them and for agents on a network.
"""
