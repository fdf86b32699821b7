"""Proofs by an observer of the whole team: the best margin, bounds on it, the paper's assumptions, and reasons in words.

Input: a team and positions. Output: `optimum.Optimum`, `certificate.Certificate`, sentences. `consat.protocols` is the counterpart for one
agent; the two packages never import each other.
"""
