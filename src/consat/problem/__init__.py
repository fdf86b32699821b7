"""What must hold: agents, their constraints and links, and the paper's objective over them.

In: agents and constraints as a user writes them. Out: a `team.Team`, in which constraints stand in families of one function each, with
their margins (`objective`), graphs and natural units. Begin with `team`. May import `consat.settings` and `consat.numerics` only.
"""
