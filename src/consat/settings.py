"""Settings of a run: start, protocol, smoothing. These pydantic models also validate the same keys of a scenario file."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

Finite = Annotated[float, Field(ge=-1e100, le=1e100, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=1e100, allow_inf_nan=False)]


def _no_boolean(value: Any) -> Any:
    if isinstance(value, bool | str):
        raise ValueError(f"is {value!r}, but must be a number")
    return value


Number = Annotated[Finite, BeforeValidator(_no_boolean)]
Gain = Annotated[Positive, BeforeValidator(_no_boolean)]
Box = tuple[Number, Number] | tuple[tuple[Number, ...], tuple[Number, ...]]
Seed = Annotated[int, Field(ge=0, lt=2**63), BeforeValidator(_no_boolean)]


def _rule(message: str) -> PydanticCustomError:
    """An error whose message is shown unchanged. It says what is wrong and what would be right."""
    return PydanticCustomError("rule", "{message}", {"message": message})


class Model(BaseModel):
    """Base of the settings: frozen, and unknown keys are errors. Error messages quote the description of a field."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class Ramp(Model):
    """Ramp of the smoothing: ν_β(t) = min(from + rate·t, to). It prevents overflow at the start (paper, section IV-F).

    Attributes:
        start: ν_β(0), in units of 1/ψ; the key in a file is ``from``.
        to: final ν_β, in units of 1/ψ, at least `start`.
        rate: increase of ν_β, in units of 1/(ψ s).
    """

    start: Gain = Field(alias="from", description="a positive number")
    to: Gain = Field(description="a positive number")
    rate: Gain = Field(description="a positive number")

    @model_validator(mode="after")
    def _rises(self) -> Ramp:
        if self.to < self.start:
            raise _rule(f"the ramp goes from {self.start:g} to {self.to:g}, but must not fall: `to` must be at least `from`")
        return self


class Smoothing(Model):
    """ν_α and ν_β of the smooth minima (paper, eq. 7 and 9), in units of 1/ψ."""

    nu_alpha: Gain = Field(description="a positive number")
    nu_beta: Gain | Ramp = Field(description="a positive number, or a ramp such as {from: 0.01, to: 5, rate: 0.022}")


class Start(Model):
    """The box in which start positions and first estimates are drawn, if not given.

    Attributes:
        box: ``[low, high]``, length: two numbers for all axes, or two lists with a number per axis. If None, the scale of the constraints
            decides; see `consat.problem.units.start_box`.
        seed: seed of the random draw.
    """

    box: Box | None = Field(None, description="[low, high] with low ≤ high: two numbers, or two lists of numbers")
    seed: Seed = Field(0, description="a whole number from 0 to 2^63 - 1")

    @field_validator("box")
    @classmethod
    def _ordered(cls, box: Box | None) -> Box | None:
        if box is not None:
            low, high = (side if isinstance(side, tuple) else (side,) for side in box)
            if len(low) != len(high) or not all(a <= b for a, b in zip(low, high, strict=True)):
                shown = [list(side) if isinstance(side, tuple) else side for side in box]
                raise _rule(f"box is {shown}, but must be [low, high] with low ≤ high")
        return box


Layout = Literal["local", "full"]
"""Which positions an agent holds estimates of."""
Sends = Literal["all", "events"]
"""When agents send: in every round, or only news."""
Stop = Literal["satisfied", "converged", "never"]
"""Condition that ends a run before its limit of time or rounds."""
ProtocolKind = Literal["interior-point", "gradient-flow", "proportional-integral", "selfish", "proximal", "admm", "max-min"]


class ProtocolSettings(Model):
    """The protocol, its estimates and its gains.

    Attributes:
        kind: name of the protocol; None for the default.
        estimates: which positions an agent holds estimates of: ``local`` those that it needs, ``full`` all (as in the paper).
        k1: gain of a flow on the gradient.
        k2: gain of a flow on the disagreement between estimates.
        penalty: initial ρ of admm, in 1/length².
        relaxation: a of admm, between 0 and 1.
        step: c of proximal, in length².
    """

    kind: ProtocolKind | None = Field(None, description=f"one of {', '.join(get_args(ProtocolKind))}")
    estimates: Layout = Field("local", description="local or full")
    k1: Gain | None = Field(None, description="a positive number")
    k2: Gain | None = Field(None, description="a positive number")
    penalty: Gain | None = Field(None, description="a positive number")
    relaxation: Annotated[Gain, Field(lt=1)] | None = Field(None, description="a number between 0 and 1")
    step: Gain | None = Field(None, description="a positive number")


class Settings(Model):
    """All settings of a run, with their defaults."""

    start: Start = Field(Start(), description="a mapping such as {box: [-4, 4], seed: 0}")
    protocol: ProtocolSettings = Field(ProtocolSettings(), description="a mapping such as {kind: admm, estimates: local}")
    smoothing: Smoothing | Literal["auto"] = Field("auto", description="auto, or a mapping such as {nu_alpha: 5, nu_beta: 5}")
