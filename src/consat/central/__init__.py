"""What one who sees the whole team can tell of it: the best margin, proven bounds, which assumptions hold, and reasons in words.

The counterpart of `consat.protocols`, which see one agent. Begin with `reference`, the optimum, and `certificate`, the bounds; what both
compute with is in `quadratics`.
"""
