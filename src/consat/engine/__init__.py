"""All agents of a team in one process: a protocol's function of one agent, mapped over everybody's copies at once.

In: a team, a layout of copies, a protocol of `consat.protocols`. Out: a `consat.results.trace.Trace`. Begin with `round`, one round of all;
`chunks` repeats it on the device, `loop` records and stops. May not import `consat.runs`, `consat.network`.
"""

from typing import Literal

Stop = Literal["satisfied", "converged", "never"]
"""When to end before the time or the rounds are up."""
