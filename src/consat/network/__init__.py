"""Agents on a network: one process each, which knows its own constraints, its neighbours' names and addresses, and nothing else.

`node` is one agent, `transports` how messages travel, `deploy` how processes are started and watched; `wire` is the format of a message.
In: a scenario, or one agent's part of it. Out: commands to bodies, JSON lines, and for an observer a `consat.results.trace.Trace`.
"""
