"""The problem: agents, their private constraints, the links between agents, and the paper's objective.

Input: agents and constraints as the user writes them. Output: a `team.Team`, which groups the constraints into families with one function
each. Begin with `team`: it checks ids (`index`), constraints (`entries`; of groups, `expansion`) and `links`. Margins are in `objective`,
graphs in `graphs`, natural scales in `units`. This package may import `consat.settings` and `consat.numerics` only.
"""
