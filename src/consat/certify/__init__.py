"""What an observer who sees the whole team can prove: the best margin, bounds, which assumptions hold, and reasons in words.

In: a team, and positions. Out: `optimum.Optimum`, `certificate.Certificate`, sentences. The counterpart of `consat.protocols`, which see
one agent; the two never import each other.
"""
