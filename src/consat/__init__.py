"""consat, collaborative satisfaction: a team of robots that satisfies its private spatial constraints together.

Arrays are held in float64 while consat computes; your own JAX settings stay as they are.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from consat import forks

__version__ = "0.1.0"

if TYPE_CHECKING:
    from consat.errors import ConsatError, InvalidExpression, InvalidInput, InvalidResult, InvalidScenario, InvalidSettings, InvalidTeam
    from consat.problem.agent import Agent
    from consat.problem.constraints import Constraint, apart, box, constraint, displacement, expr, halfspace, near, outside, within
    from consat.problem.groups import Group, each
    from consat.problem.objective import margins
    from consat.problem.schedule import Schedule, schedule
    from consat.problem.team import Team
    from consat.results.result import Result
    from consat.robots import Double, Point, Quadrotor, Unicycle, disc, polygon
    from consat.runs.runner import resume, run
    from consat.runs.session import Session
    from consat.runs.solving import solve
    from consat.runs.sweeping import Sweep, sweep
    from consat.scenario import Scenario, dump, load, loads
    from consat.server.handle import live
    from consat.settings import Ramp, Settings, Smoothing

_HOME = {
    "problem.constraints": ("Constraint", "apart", "box", "constraint", "displacement", "expr", "halfspace", "near", "outside", "within"),
    "errors": (
        "ConsatError", "InvalidExpression", "InvalidInput", "InvalidResult", "InvalidScenario", "InvalidSettings", "InvalidTeam",
    ),
    "problem.objective": ("margins",),
    "results.result": ("Result",),
    "robots": ("Double", "Point", "Quadrotor", "Unicycle", "disc", "polygon"),
    "runs.runner": ("resume", "run"),
    "runs.session": ("Session",),
    "runs.solving": ("solve",),
    "runs.sweeping": ("Sweep", "sweep"),
    "scenario": ("Scenario", "dump", "load", "loads"),
    "server.handle": ("live",),
    "settings": ("Ramp", "Settings", "Smoothing"),
    "problem.groups": ("Group", "each"),
    "problem.schedule": ("Schedule", "schedule"),
    "problem.agent": ("Agent",),
    "problem.team": ("Team",),
}  # fmt: skip
forks.watch()
_MODULE = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "Agent", "ConsatError", "Constraint", "Double", "Group", "InvalidExpression", "InvalidInput", "InvalidResult", "InvalidScenario",
    "InvalidSettings", "InvalidTeam", "Point", "Quadrotor", "Ramp", "Result", "Scenario", "Schedule", "Session", "Settings", "Smoothing",
    "Sweep", "Team", "Unicycle", "apart", "box", "constraint", "disc", "displacement", "dump", "each", "expr", "halfspace", "live",
    "load", "loads", "margins", "near", "outside", "polygon", "resume", "run", "schedule", "solve", "sweep", "within",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Load a public name when it is first used, so that ``import consat`` costs nothing."""
    if name not in _MODULE:
        raise AttributeError(f"module 'consat' has no attribute {name!r}")
    from importlib import import_module

    value = getattr(import_module(f"consat.{_MODULE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
