"""Local optimization steps of an agent: the proximal step (`proximal`) and the interior-point step (`interior`).

Input: the agent's constraints on its copies and the last messages of its neighbours. Output: new copies and a message for each neighbour.
"""
