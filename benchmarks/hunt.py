"""Hunt for ψ that consat cannot take: random compositions of what expressions and callables allow, at check, run, solve and plot.

    python benchmarks/hunt.py --count 200            teams of seeds 0 to 199; prints a line for each failure, then the counts
    python benchmarks/hunt.py --seed 17 --count 1    one team again, with its constraints
    python benchmarks/hunt.py --only check solve     some of the commands

Each seed draws one team of 1 to 5 agents in 1 to 6 dimensions: ψ with poles, edges of domains, plateaus, kinks, steep and flat ones, ψ that
are constant in an argument, as text and as Python functions, with and without parameters. A formation is hidden in most of them, at which
every ψ is positive. What counts as a failure:

error      an exception, or any warning
nan        a NaN in the record of a run, or in an answer
false      a margin that is not the one that NumPy computes; "feasible" without a formation, "infeasible" or a bound that SciPy or another
           protocol refutes; "concave" where a chord shows the contrary
missed     SciPy satisfies the team from at least two of three starts, and a run does not

SciPy is the independent optimiser: BFGS on a soft minimum of ψ, which NumPy evaluates from the same text.
"""

from __future__ import annotations

import argparse
import functools
import json
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import CodeType
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import consat as cs
from consat.certify import assumptions
from consat.numerics import float64

PROTOCOLS = ("interior-point", "admm", "gradient-flow")
"""Of `run`, beside the default, ``run``, which also looks from other starts."""
SETTLES = ("run", "interior-point", "admm")
"""Those of which it is counted how often they satisfy what SciPy does."""
COMMANDS = ("check", "run", *PROTOCOLS, "solve", "plot")
BOX = 4.0
"""Starts are drawn in this box, and so is the formation that is hidden."""


def _names(np_: Any) -> dict[str, Any]:
    """What the text of a ψ may name, from NumPy or JAX."""
    names = {
        name: getattr(np_, name) for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "sinh", "cosh", "tanh", "square", "dot", "sum")
    }
    inverse = {name: getattr(np_, f"arc{name[1:]}") for name in ("asin", "acos", "atan")}
    return names | inverse | {
        "norm2": lambda v: np_.sum(v**2), "norm": lambda v: np_.sqrt(np_.sum(v**2)), "largest": lambda v: np_.max(np_.abs(v)),
        "total": lambda v: np_.sum(np_.abs(v)), "maximum": np_.maximum, "minimum": np_.minimum, "absolute": np_.abs,
    }  # fmt: skip


NUMPY, JAX = _names(np), _names(jnp)
CALLABLES_ONLY = ("largest", "total", "maximum", "minimum", "absolute")


@functools.lru_cache(maxsize=1000)
def _compiled(text: str) -> CodeType:
    return compile(text, "psi", "eval")


@dataclass(frozen=True)
class Psi:
    """A ψ: its text, whose positions it reads, and how it is given: ``text``, ``function``, or ``parameters``."""

    text: str
    reads: tuple[str, ...]
    form: str

    def value(self, at: dict[str, np.ndarray]) -> float:
        """By NumPy alone; −∞ where it is no finite number."""
        with np.errstate(all="ignore"):
            value = float(eval(_compiled(self.text), {"__builtins__": {}}, NUMPY | {name: at[name] for name in self.reads}))  # noqa: S307
        return value if np.isfinite(value) else -np.inf

    def constraint(self) -> cs.Constraint:
        if self.form == "text":
            return cs.expr(self.text)
        code = _compiled(self.text)

        def psi(*positions: Any, **parameters: Any) -> Any:
            value = eval(code, {"__builtins__": {}}, JAX | dict(zip(self.reads, positions, strict=True)))  # noqa: S307
            return value * parameters["factor"] if parameters else value

        return cs.constraint(psi, reads=self.reads, **({"factor": 1.0} if self.form == "parameters" else {}))


@dataclass(frozen=True)
class Case:
    """A team, as drawn from a seed."""

    seed: int
    dimension: int
    agents: dict[str, list[Psi]]

    @property
    def team(self) -> cs.Team:
        return cs.Team([cs.Agent(name, [psi.constraint() for psi in each]) for name, each in self.agents.items()], dimension=self.dimension)

    def margin(self, positions: np.ndarray) -> float:
        """β̄ by NumPy."""
        at = dict(zip(self.agents, positions, strict=True))
        return min((psi.value(at) for each in self.agents.values() for psi in each), default=np.inf)

    def soft(self, flat: np.ndarray, nu: float) -> float:
        """−β, large but finite where a ψ is none."""
        at = dict(zip(self.agents, flat.reshape(len(self.agents), -1), strict=True))
        values = np.array([psi.value(at) for each in self.agents.values() for psi in each])
        if not np.isfinite(values).all():
            return 1e9
        low = values.min()
        return float(-low + np.log(np.sum(np.exp(-nu * (values - low)))) / nu)

    def easy(self) -> float | None:
        """The best margin that SciPy finds, if it satisfies the team from at least two of three starts; else None."""
        rng, margins = np.random.default_rng([self.seed, 1]), []
        for _ in range(3):
            x = rng.uniform(-BOX, BOX, len(self.agents) * self.dimension)
            for nu in (1.0, 10.0):
                with np.errstate(all="ignore"), warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    x = minimize(self.soft, x, args=(nu,), method="BFGS", options={"maxiter": 200}).x
            margins.append(self.margin(x.reshape(len(self.agents), -1)))
        return max(margins) if sum(margin > 1e-3 for margin in margins) >= 2 else None


def draw(seed: int) -> Case:
    """The team of a seed."""
    rng = np.random.default_rng(seed)
    d, names = int(rng.integers(1, 7)), list("abcde")[: int(rng.integers(1, 6))]
    hidden = {name: rng.uniform(-0.6 * BOX, 0.6 * BOX, d) for name in names}
    agents = {name: [_psi(rng, name, names, hidden, d) for _ in range(int(rng.integers(1, 4)))] for name in names}
    return Case(seed, d, agents)


def _psi(rng: np.random.Generator, owner: str, names: list[str], hidden: dict[str, np.ndarray], d: int) -> Psi:
    """One ψ of an agent, positive at the hidden formation nine times out of ten."""
    for _ in range(100):
        others = [name for name in names if name != owner]
        reads = [owner, *rng.permutation(others)[: int(rng.integers(0, len(others) + 1))].tolist()]
        kinked = bool(rng.random() < 0.25)
        text = _wild(rng, _inner(rng, reads, d, kinked))
        if rng.random() < 0.2:  # two of them
            text = f"({text}) {rng.choice(['+', '-', '*'])} ({_wild(rng, _inner(rng, reads, d, False))})"
        if rng.random() < 0.15:
            text = f"{rng.choice([1e4, 1e-4]):g}*({text})"
        used = [name for name in reads if _reads(text, name)]
        if len(reads) > 1 and rng.random() < 0.1:
            missing = [name for name in reads if name not in used]
            text = " + ".join([text, *(f"0*norm2({name})" for name in missing)])
            used = reads
        if owner not in used:
            continue
        there = Psi(text, tuple(used), "").value(hidden)
        if not np.isfinite(there) or abs(there) > 1e6:
            continue
        room = rng.uniform(0.05, 1.0) * max(abs(there), 0.3)
        shift = there - room if rng.random() < 0.9 else there + room
        if shift and rng.random() < 0.8:
            text = f"{text} - {shift:.4f}" if shift > 0 else f"{text} + {-shift:.4f}"
        elif there <= 0:
            continue
        callable_only = any(name in text for name in CALLABLES_ONLY)
        form = str(rng.choice(["function", "parameters"] if callable_only else ["text", "text", "function", "parameters"]))
        reads_ = tuple(name for name in reads if _reads(text, name))
        return Psi(text, reads_, form)
    return Psi(f"9 - norm2({owner})", (owner,), "text")


def _reads(text: str, name: str) -> bool:
    import re

    return re.search(rf"\b{name}\b", text) is not None


def _inner(rng: np.random.Generator, reads: list[str], d: int, kinked: bool) -> str:
    """A number made of positions."""
    centre = "[" + ", ".join(f"{value:.2f}" for value in rng.uniform(-2, 2, d)) + "]"
    chosen = rng.permutation(reads[1:]).tolist()[: int(rng.integers(0, len(reads)))]
    vector = " - ".join([reads[0], *chosen]) if chosen else f"{reads[0]}*{rng.choice([1.0, 0.5, 2.0]):g}"
    if len(chosen) > 1:
        vector = f"{reads[0]} - ({' + '.join(chosen)})/{len(chosen)}"
    if not chosen and rng.random() < 0.3:
        vector = f"{reads[0]} + {rng.uniform(-1, 1):.2f}*{reads[0]}"
    axis = int(rng.integers(d))
    options = [
        f"norm2({vector})",
        f"norm2({vector})",
        f"norm({vector})",
        f"({vector})[{axis}]",
        f"sum({vector})",
        f"dot({vector}, {reads[0]})",
    ]
    if kinked:
        options = [f"largest({vector})", f"total({vector})", f"maximum(norm({vector}), {rng.uniform(0.2, 1):.2f})",
                   f"minimum(norm2({vector}), 9.0)", f"absolute(({vector})[{axis}])"]  # fmt: skip
    del centre
    return str(rng.choice(options))


def _wild(rng: np.random.Generator, u: str) -> str:
    """A function of one number, of those that end, saturate, bend or explode."""
    c = f"{rng.uniform(1, 9):.2f}"
    return str(rng.choice([
        f"{c} - {u}", f"{c} - {u}", f"{u} - {c}", f"{c} - 1/{u}", f"1/{u}", f"{c} - 1/({u})**2", f"log({u})", f"log({c} - {u})", f"{c} - log({u})",
        f"sqrt({c} - {u})", f"sqrt({u})", f"tanh({c} - {u})", f"atan({u} - {c})", f"1 - exp({u} - {c})", f"exp({c} - {u})", f"sin({u})", f"cos({u})",
        f"({c} - {u})**1.5", f"({u})**-1", f"({u})**3", f"asin({u}/{c})", f"acos({u}/{c})", f"tan({u}/{c})", f"{c} - cosh({u})", f"sinh({u})/10",
        f"square({c} - {u})", f"exp({u})/(1 + exp({u})) - 0.5", f"1/(1 + ({u})**2)", f"log(1 + exp({c} - {u}))",
    ]))  # fmt: skip


@dataclass
class Found:
    """What became of a team."""

    case: Case
    failures: list[tuple[str, str, str]] = field(default_factory=list)
    said: dict[str, Any] = field(default_factory=dict)

    def fail(self, kind: str, command: str, what: str) -> None:
        self.failures.append((kind, command, what))


def examine(case: Case, commands: tuple[str, ...] = COMMANDS) -> Found:
    """Everything that is asked of one team."""
    found = Found(case)
    steps: dict[str, Callable[[Found, cs.Team], None]] = {"check": _check, "solve": _solve, "plot": _plot}
    team = case.team
    for command in commands:
        step = steps.get(command) or (lambda found, team, command=command: _run(found, team, command))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                step(found, team)
            except Exception as error:  # noqa: BLE001 - that is what is hunted
                where = traceback.extract_tb(error.__traceback__)[-1]
                mine = [f for f in traceback.extract_tb(error.__traceback__) if "/consat/" in f.filename]
                where = mine[-1] if mine else where
                found.fail(
                    "error",
                    command,
                    f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''} ({where.filename.rsplit('/', 1)[-1]}:{where.lineno})",
                )
    _compare(found)
    return found


def _check(found: Found, team: cs.Team) -> None:
    told = float64(assumptions.report)(team)
    json.dumps(told, allow_nan=False)
    rng = np.random.default_rng([found.case.seed, 2])
    psis = [psi for each in found.case.agents.values() for psi in each]
    for psi, line in zip(psis, told["constraints"], strict=True):
        if "concave" not in line["curvature"] or line["curvature"] == "not-concave":
            continue
        for _ in range(200):
            ends = [{name: rng.uniform(-BOX, BOX, found.case.dimension) for name in psi.reads} for _ in range(2)]
            middle = {name: 0.5 * (ends[0][name] + ends[1][name]) for name in psi.reads}
            low, high, chord = psi.value(ends[0]), psi.value(ends[1]), psi.value(middle)
            if np.isfinite([low, high]).all() and chord < 0.5 * (low + high) - 1e-9 * (1 + abs(low) + abs(high)):
                found.fail("false", "check", f"{line['curvature']}: {psi.text}")
                break
    found.said["convex"] = told["convex"]


def _run(found: Found, team: cs.Team, protocol: str) -> None:
    given: dict[str, Any] = {"protocol": protocol, "rounds": 500, "stop": "satisfied"}
    if protocol == "run":
        given = {}
    elif protocol == "gradient-flow":
        given = {"protocol": protocol, "until": 60.0, "stop": "satisfied"}
    result = cs.run(team, seed=found.case.seed, start=(-BOX, BOX), **given)
    told = result.summary
    json.dumps(told, allow_nan=False)
    print_ = str(result)
    del print_
    trace = result._trace
    for name in ("position", "margin", "agent_margin", "estimate", "integral", "smooth_margin", "velocity"):
        values = getattr(trace, name)
        if values is not None and np.isnan(values).any():
            found.fail(
                "nan",
                protocol,
                f"{name} from step {int(np.flatnonzero(np.isnan(values).reshape(len(values), -1).any(axis=1))[0])} of {len(values)}, {told['status']}",
            )
    positions = np.array(list(told["positions"].values()), dtype=float)
    if np.isfinite(positions).all():
        _margin(found, protocol, positions, told["margin"])
    found.said[protocol] = {key: told[key] for key in ("status", "verdict", "margin", "bounds", "rounds")}
    found.said["result"] = result


def _margin(found: Found, command: str, positions: np.ndarray, said: float | None) -> None:
    true, said = found.case.margin(positions), -np.inf if said is None else said
    if not (true == said or abs(true - said) <= 1e-6 * max(1.0, abs(true))):
        found.fail("false", command, f"margin {said}, but NumPy has {true}")


def _solve(found: Found, team: cs.Team) -> None:
    told = cs.solve(team)
    json.dumps(told, allow_nan=False)
    positions = np.array(list(told["positions"].values()), dtype=float)
    if not np.isfinite(positions).all():
        found.fail("nan", "solve", "positions")
    else:
        _margin(found, "solve", positions, told["margin"])
    found.said["solve"] = {key: told[key] for key in ("verdict", "margin", "bounds")}


def _plot(found: Found, team: cs.Team) -> None:
    if "result" in found.said:
        with tempfile.TemporaryDirectory() as directory:
            found.said["result"].plot(directory)


def _compare(found: Found) -> None:
    """Verdicts and bounds against everything that was found, and runs against SciPy."""
    easy = found.case.easy()
    found.said["easy"] = easy
    told = {name: said for name, said in found.said.items() if isinstance(said, dict)}
    best = max(
        [easy if easy is not None else -np.inf, *(said["margin"] for said in told.values() if said["margin"] is not None)], default=-np.inf
    )
    for name, said in told.items():
        upper = said["bounds"][1]
        if said["verdict"] == "feasible" and not (said["margin"] is None or said["margin"] > 0):
            found.fail("false", name, f"feasible at {said['margin']}")
        if said["verdict"] == "infeasible" and best > 0:
            found.fail("false", name, f"infeasible, but {best} was found")
        if upper is not None and best > upper + 1e-6 * max(1.0, abs(upper)):
            found.fail("false", name, f"bound {upper}, but {best} was found")
        if name in SETTLES and easy is not None and said["status"] != "satisfied":
            found.fail("missed", name, f"{said['status']} at {said['margin']}, SciPy has {easy}")


def hunt(seeds: range, commands: tuple[str, ...]) -> Iterator[Found]:
    """The teams of these seeds."""
    for seed in seeds:
        yield examine(draw(seed), commands)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the first team")
    parser.add_argument("--count", type=int, default=200, help="how many teams")
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=COMMANDS)
    asked = parser.parse_args()
    began, counts, easy = time.perf_counter(), Counter(), Counter()
    for found in hunt(range(asked.seed, asked.seed + asked.count), tuple(asked.only)):
        for kind, command, what in found.failures:
            print(f"{found.case.seed:5d}  {kind:7s} {command:14s} {what}", flush=True)
            counts[kind, command] += 1
        for name in SETTLES:
            if name in found.said and found.said["easy"] is not None:
                easy[name, found.said[name]["status"] == "satisfied"] += 1
        if asked.count == 1:
            print(json.dumps({name: said for name, said in found.said.items() if name != "result"}, indent=1))
            for name, each in found.case.agents.items():
                print(name, *(f"\n    {psi.form:10s} {psi.text}" for psi in each))
    print(f"{asked.count} teams in {time.perf_counter() - began:.0f} s, seeds {asked.seed} to {asked.seed + asked.count - 1}")
    print("failures:", {f"{kind} at {command}": number for (kind, command), number in sorted(counts.items())} or "none")
    for name in SETTLES:
        print(f"{name}: satisfies {easy[name, True]} of {easy[name, True] + easy[name, False]} teams that SciPy satisfies easily")


if __name__ == "__main__":
    main()
