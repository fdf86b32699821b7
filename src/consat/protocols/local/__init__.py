"""An agent's own small problem: the proximal step of admm, the step of the interior point.

In: an agent's constraints over its copies, and what its neighbours last said. Out: new copies, and what to tell each neighbour.
"""
