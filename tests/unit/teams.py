"""Teams that several tests share."""

from __future__ import annotations

import numpy as np

import consat as cs

MARGINS = {"a": 1.0, "b": 1.0, "c": 0.18608, "d": -0.08144}
"""The best margins of the paper's cases, to five digits (design, section 2)."""


def tug(near: float, nearer: float, unit: float = 1.0, offset: float = 0.0) -> cs.Team:
    """Cases B, C and D of the paper: two discs, and one in between that is to be near both; in units of length `unit`."""
    return cs.Team(
        [
            cs.Agent("a1", [cs.within([2 * unit + offset, offset], unit)]),
            cs.Agent("a2", [cs.near("a1", near * unit), cs.near("a3", nearer * unit)]),
            cs.Agent("a3", [cs.within([-2 * unit + offset, offset], unit)]),
        ],
        links="line",
    )


def case(letter: str, unit: float = 1.0, offset: float = 0.0) -> cs.Team:
    """The paper's cases A to E."""
    if letter == "a":
        chain = [cs.Agent("a2", [cs.near("a1", unit)]), cs.Agent("a3", [cs.near("a2", unit)])]
        return cs.Team([cs.Agent("a1", [cs.within([2 * unit + offset, offset], unit)]), *chain], links="line")
    if letter == "e":
        return cs.Team(
            [
                cs.Agent("a1", [cs.within([2, 0], 1)]),
                cs.Agent("a2", [cs.near("a1", 1), cs.apart("a1", 0.2)]),
                cs.Agent("a3", [cs.near("a2", 1), cs.near("a1", 1), cs.apart("a1", 0.2), cs.apart("a2", 0.2)]),
            ],
            links="line",
        )
    near, nearer = {"b": (3, 2), "c": (1.7, 0.7), "d": (1.4, 0.4)}[letter]
    return tug(near, nearer, unit, offset)


def grid(count: int) -> cs.Team:
    """About five constraints an agent: a disc, two tethers, a displacement, a wall."""
    width, random = int(np.ceil(np.sqrt(count))), np.random.default_rng(0)
    agents = []
    for i in range(count):
        constraints = [cs.within([i % width, i // width], 1.5), cs.halfspace(random.normal(size=2), 2.0 * width)]
        if i % width:
            constraints.append(cs.near(f"g{i - 1}", 0.8))
        if i >= width:
            constraints.append(cs.near(f"g{i - width}", 0.8))
        if i % width and i >= width:
            constraints.append(cs.displacement(f"g{i - width - 1}", [1, 1], 1))
        agents.append(cs.Agent(f"g{i}", constraints))
    return cs.Team(agents)


def many(count: int, seed: int, dimension: int, decades: float = 2.0) -> cs.Team:
    """`count` random concave problems of 1 to 4 agents each, as the clusters of one team; feasible and not, in units up to 10**±decades."""
    random = np.random.default_rng(seed)
    agents = []
    for c in range(count):
        unit, size = 10.0 ** random.uniform(-decades, decades), int(random.integers(1, 5))
        for i in range(size):
            constraints = []
            own = random.random()
            center = random.normal(size=dimension) * unit
            if own < 0.6 or (i == 0 and own < 0.9):
                constraints.append(cs.within(center, unit * random.uniform(0.3, 2), weight=float(random.choice([1, 1, 3, 0.2]))))
            elif own < 0.9:
                constraints.append(cs.box(center - unit, center + unit * random.uniform(-0.5, 2, dimension)))
            elif i == 0:
                constraints.append(cs.box(center - unit, center + unit))
            if random.random() < 0.3:
                constraints.append(cs.halfspace(random.normal(size=dimension), unit * random.normal(), weight=unit))
            if i:
                j = int(random.integers(i))
                if random.random() < 0.7:
                    constraints.append(cs.near(f"{c}.{j}", unit * random.uniform(0.2, 2), weight=float(random.choice([1, 1, 2]))))
                else:
                    constraints.append(cs.displacement(f"{c}.{j}", random.normal(size=dimension) * unit, unit * random.uniform(0.2, 2)))
            agents.append(cs.Agent(f"{c}.{i}", constraints))
    return cs.Team(agents, dimension=dimension)
