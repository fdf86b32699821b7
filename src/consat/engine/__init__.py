"""Simulation of all agents of a team: the per-agent functions of a protocol, applied to the copies of all agents at once.

Input: a team, a layout of copies, a protocol of `consat.protocols`. Output: a `consat.results.trace.Trace`. Start reading at `round`, one
round of all agents on the data of `world`; `chunks` repeats it on the device, `rules` stop it, and `loop` records. Must not import
`consat.runs` or `consat.network`.
"""
