"""Options of a run: the arguments of `run` as one frozen object, with checks; a checkpoint can store it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self, get_args

import numpy as np

from consat.engine.bodies import Body
from consat.engine.recording import Who
from consat.errors import InvalidSettings
from consat.faults import Faults
from consat.problem.team import Team
from consat.settings import Layout, Sends, Smoothing, Stop

if TYPE_CHECKING:
    from consat.scenario.robots import Robots

RATE = 20.0
"""Default rate of rounds, Hz, where constraints move with time or robots drive."""
WATCHED = 60.0
"""Default duration, s, of a run with constraints that read the time and have no schedule."""


class Pace(NamedTuple):
    """Number and timing of the rounds.

    Attributes:
        rounds: number of rounds; None to run until a stop rule holds.
        least: number of rounds before a stop rule may end the run.
        body: motion of the bodies in a round; None where rounds take no time.
    """

    rounds: int | None
    least: int
    body: Body | None


@dataclass(frozen=True, kw_only=True)
class Options:
    """Arguments of `consat.run`; see there."""

    protocol: str | None = None
    estimates: Layout | None = None
    seed: int | None = None
    start: tuple[Any, Any] | None = None
    smoothing: Smoothing | Literal["auto"] | None = None
    until: float | None = None
    rounds: int | None = None
    stop: Stop | None = None
    loss: float = 0.0
    sleep: float = 0.0
    rate: float | None = None
    speed: float | None = None
    auxiliary: float | None = None
    record: bool | None = None
    agents: Who = None
    every: int = 1
    robots: Robots | None = None
    wind: tuple[float, ...] = ()
    noise: float = 0.0
    simulator: str | None = None
    restarts: int | None = None
    burst: tuple[float, float] | None = None
    sends: Sends = "all"

    def __post_init__(self) -> None:
        if self.sends not in get_args(Sends):
            raise InvalidSettings(f"sends is {self.sends!r}, but must be one of {', '.join(get_args(Sends))}")

    @property
    def events(self) -> bool:
        """Whether agents send only what is news."""
        return self.sends == "events"

    @property
    def data(self) -> dict[str, Any]:
        """The options as JSON-serialisable data."""
        robots = None if self.robots is None else self.robots.data
        return {field.name: _as_data(getattr(self, field.name)) for field in dataclasses.fields(self)} | {"robots": robots}

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Self:
        """Options from `data`."""
        from consat.scenario.robots import Robots

        smoothing, robots = data["smoothing"], data["robots"]
        made = {
            "smoothing": smoothing if smoothing in (None, "auto") else Smoothing.model_validate(smoothing),
            "robots": None if robots is None else Robots.of(robots),
        }
        burst = None if data["burst"] is None else tuple(data["burst"])
        return cls(**{**data, "wind": tuple(data["wind"]), "burst": burst, **made})

    def stop_for(self, kind: str) -> Stop:
        """Stop condition of a run with the protocol `kind`."""
        if self.stop is not None:
            return self.stop
        if self.until is not None or self.rounds is not None:
            return "never"
        return "converged" if kind == "max-min" else "satisfied"

    @property
    def many_starts(self) -> bool:
        """Whether several starts are asked for."""
        return self.restarts is not None and self.restarts > 1

    def takes_time(self, team: Team) -> bool:
        """Whether bodies take time to where their agents want them, or constraints move meanwhile."""
        return self.rate is not None or self.robots is not None or team.moves

    def require_flow(self, kind: str, team: Team) -> None:
        """Check the options for a continuous-time protocol. Raises: InvalidSettings: an option applies only to rounds."""
        given = {
            name: getattr(self, name)
            for name in ("rounds", "loss", "sleep", "burst", "rate", "speed", "robots", "wind", "noise", "simulator")
        }
        given |= {"restarts": self.restarts not in (None, 1), "sends": self.events}
        if wrong := [name for name, value in given.items() if value]:
            message = f"protocol {kind} flows in continuous time; use until; {', '.join(wrong)} means nothing to it"
            raise InvalidSettings(message)
        if team.moves:
            raise InvalidSettings(f"constraints move with time, and protocol {kind} flows without rounds; use a protocol in rounds")

    def faults(self, seed: int) -> Faults:
        """Faults of messages and agents. Raises: InvalidSettings: a probability is out of range."""
        return Faults(self.loss, self.sleep, seed, self.burst)

    def _driven(self, team: Team, rate: float) -> dict[str, Any]:
        """Keyword arguments of `Body` for robots; empty without robots. `rate`: rounds per second, Hz."""
        if self.robots is None:
            return {}
        if self.speed is not None:
            raise InvalidSettings("speed is of bodies that are points; robots have a speed of their own, robots: {speed: ..}")
        if len(self.wind) not in (0, team.dimension) or not all(map(math.isfinite, self.wind)):
            raise InvalidSettings(f"wind is {list(self.wind)}, but must be {team.dimension} numbers, m/s")
        if not (math.isfinite(self.noise) and self.noise >= 0):
            raise InvalidSettings(f"noise is {self.noise}, but must be a length from 0, m")
        from consat.robots import Drive, simulated

        model = self.robots.fleet(list(team.ids))
        if self.simulator is not None:
            model = simulated(self.simulator, model, team.count, team.dimension, self.robots.obstacles)
        drive = Drive(model, team.count, team.dimension, 1.0 / rate, self.robots.obstacles, noise=self.noise)
        return {"drive": drive, "wind": self.wind, "noise": self.noise}

    def pace(self, kind: str, team: Team) -> Pace:
        """Number and timing of the rounds for the protocol `kind`. Raises: InvalidSettings: the options contradict each other."""
        if self.restarts is not None and self.restarts < 1:
            raise InvalidSettings(f"restarts is {self.restarts}, but must be at least 1: from how many starts to run")
        if self.many_starts and self.takes_time(team):
            raise InvalidSettings(
                "restarts are of agents that are where they want to be; rate, robots and moving constraints mean nothing there"
            )
        rate = RATE if self.rate is None and (team.moves or self.robots is not None) else self.rate
        if self.robots is None and (self.wind or self.noise or self.simulator):
            raise InvalidSettings("wind, noise and simulator mean something to robots only; give robots, too")
        if (self.speed is not None and rate is None) or not all(value is None or value > 0 for value in (self.speed, rate)):
            raise InvalidSettings("speed and rate must be positive, and speed needs rate: a body moves at most speed/rate a round")
        body = None if rate is None else Body(rate, np.inf if self.speed is None else self.speed, **self._driven(team, rate))
        if self.until is None:
            knots = team.knots
            horizon = float(knots.max()) if len(knots) else WATCHED
            least = math.ceil(horizon * body.rate) if body is not None and team.moves and self.rounds is None else 0
            return Pace(self.rounds, least, body)
        if self.rounds is not None:
            raise InvalidSettings("until and rounds both say when the run ends; use one of them")
        if body is None:
            message = f"protocol {kind} goes in rounds; use rounds; until means something to it together with rate, rounds a second"
            raise InvalidSettings(message)
        if not (math.isfinite(self.until) and self.until >= 0):
            raise InvalidSettings(f"until is {self.until}, but must be a time, s")
        return Pace(round(self.until * body.rate), 0, body)


def _as_data(value: Any) -> Any:
    if isinstance(value, Smoothing):
        return value.model_dump(by_alias=True)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value if isinstance(value, str) or not isinstance(value, Sequence) else [_as_data(each) for each in value]
