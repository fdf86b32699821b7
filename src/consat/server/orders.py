"""Orders of a page: JSON of bounded size. All fields are checked before anything happens; nothing is evaluated."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Final, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from consat.errors import InvalidSettings, shown

LONGEST: Final = 4096
"""Largest size of an order, bytes."""
MOST_ROUNDS: Final = 1000
FASTEST: Final = 1000.0

Number: TypeAlias = Annotated[int, Field(ge=0, lt=2**53)] | None
Name: TypeAlias = Annotated[str, Field(min_length=1, max_length=200)]
Text: TypeAlias = Annotated[str, Field(max_length=2000)]
Vector: TypeAlias = Annotated[list[float], Field(min_length=1, max_length=64)]
Place: TypeAlias = Annotated[int, Field(ge=0, lt=2**31)]
Names: TypeAlias = Annotated[list[Name], Field(max_length=64)]
Parameters: TypeAlias = Annotated[dict[Name, float | Vector], Field(min_length=1, max_length=8)]
Described: TypeAlias = Annotated[dict[Name, float | Vector | Text], Field(max_length=12)]
"""A constraint, as in a scenario file."""


class Order(BaseModel):
    """Base of all orders: a number that the answer repeats, and the gesture that the order belongs to. A gesture is undone as a whole."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    id: Number = None
    gesture: Number = None

    about: ClassVar[tuple[str, ...]] = ()
    """Fields that say what is set."""

    @property
    def subject(self) -> tuple[Any, ...] | None:
        """What the order sets. It replaces earlier orders of the same gesture with the same subject; None if it replaces none."""
        if not self.about:
            return None
        values = (getattr(self, name) for name in self.about)
        keys = (tuple(sorted(value)) if isinstance(value, dict) else value for value in values)
        return type(self).__name__, *keys, tuple(sorted(self.model_fields_set))


class Change(Order):
    """Change parameters of a constraint."""

    about = ("agent", "constraint", "parameters")
    do: Literal["change"]
    agent: Name
    constraint: Name
    parameters: Parameters


class Shape(Order):
    """Move or resize a ball, given by its index in the scene, for all its owners."""

    about = ("scene", "shape")
    do: Literal["shape"]
    scene: Place
    shape: Place
    center: Vector | None = None
    radius: float | None = None


class Wall(Order):
    """Move a half-space, given by its index in the scene, along its normal, for all its owners."""

    about = ("scene", "wall")
    do: Literal["wall"]
    scene: Place
    wall: Place
    offset: float


class Put(Order):
    """Move an agent."""

    about = ("agent",)
    do: Literal["place"]
    agent: Name
    position: Vector


class Add(Order):
    """Add an agent."""

    do: Literal["add"]
    agent: Name
    position: Vector
    constraints: Annotated[list[Described], Field(max_length=16)] = []
    links: Names | None = None


class OfAgent(Order):
    """Remove, kill or revive an agent."""

    do: Literal["remove", "kill", "revive"]
    agent: Name


class OfLink(Order):
    """Add or remove a link."""

    do: Literal["connect", "disconnect"]
    one: Name
    other: Name


class AddConstraint(Order):
    """Add a constraint."""

    do: Literal["add_constraint"]
    agent: Name
    constraint: Described


class RemoveConstraint(Order):
    """Remove a constraint."""

    do: Literal["remove_constraint"]
    agent: Name
    constraint: Name


class Step(Order):
    """Step some rounds while the session is paused."""

    do: Literal["step"]
    rounds: Annotated[int, Field(ge=1, le=MOST_ROUNDS)] = 1


class Speed(Order):
    """Set the rounds per second."""

    do: Literal["speed"]
    rounds: Annotated[float, Field(gt=0, le=FASTEST)]


class Loss(Order):
    """Set the share of messages that are lost."""

    do: Literal["loss"]
    share: Annotated[float, Field(ge=0, lt=1)]


class Protocol(Order):
    """Start another protocol from the present positions."""

    do: Literal["protocol"]
    kind: Name


class Plain(Order):
    """An order without arguments."""

    do: Literal["play", "pause", "undo", "restart", "text"]


Any_: TypeAlias = Annotated[
    Change | Shape | Wall | Put | Add | OfAgent | OfLink | AddConstraint | RemoveConstraint | Step | Speed | Loss | Protocol | Plain,
    Field(discriminator="do"),
]
_ORDER: Final[TypeAdapter[Any]] = TypeAdapter(Any_)


def parse(raw: str | bytes) -> Order:
    """Read an order from a message.

    Raises:
        InvalidSettings: the message is not an order; says what is wrong.
    """
    content = _content(raw)
    if len(content) > LONGEST:
        raise InvalidSettings(f"the message has {len(content):,} bytes, but may have at most {LONGEST:,}")
    try:
        order: Order = _ORDER.validate_json(content)
    except ValidationError as error:
        raise InvalidSettings(_words(error)) from None
    return order


class _Numbered(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True)

    id: Number = None


def number_of(raw: str | bytes) -> int | None:
    """The number of a message that is not an order, for its answer; None if it has none."""
    content = _content(raw)
    try:
        return None if len(content) > LONGEST else _Numbered.model_validate_json(content).id
    except ValidationError:
        return None


def _content(raw: str | bytes) -> bytes:
    return raw.encode("utf-8", "surrogatepass") if isinstance(raw, str) else raw


def _words(error: ValidationError) -> str:
    """The first fault, in words."""
    first = error.errors(include_url=False, include_context=False)[0]
    place = ".".join(str(part) for part in first["loc"][1:] if not isinstance(part, str) or part.isidentifier())
    given = "" if first["type"] in ("missing", "json_invalid") else f"; it is {shown(first['input'])}"
    return f"{place[:100] or 'message'}: {first['msg'][0].lower()}{first['msg'][1:]}{given}"
