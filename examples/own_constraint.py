"""Four robots: a leader on patrol ground, two wingmen at a distance, a relay that must see both; one constraint is our own function."""

import jax.numpy as jnp

import consat as cs


def in_view(relay, left, right):
    """Positive while the relay sees both wingmen within 120°: it is near enough to the middle between them, compared to their distance."""
    middle = 0.5 * (left + right)
    return 1.5**2 - jnp.sum((relay - middle) ** 2) - 0.1 * jnp.sum((left - right) ** 2)


team = cs.Team(
    [
        cs.Agent("leader", [cs.within([0, 0], radius=1), cs.halfspace([0, 1], offset=0.5, name="south of the wall")]),
        cs.Agent("left", [cs.displacement("leader", [-2, -1], radius=0.8), cs.apart("right", radius=2)]),
        cs.Agent("right", [cs.displacement("leader", [2, -1], radius=0.8)]),
        cs.Agent("relay", [cs.constraint(in_view, reads=("relay", "left", "right"), name="in view")]),
    ],
    links="task",
)

result = cs.run(team, seed=1)
print(result)
assert result.summary["status"] == "satisfied"
