"""How a team is run: start, protocol, smoothing, stop. The same models are the schema of these keys in a scenario file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, le=1e100, allow_inf_nan=False)]


def _no_boolean(value: Any) -> Any:
    if isinstance(value, bool | str):
        raise ValueError(f"is {value!r}, but must be a number")
    return value


Number = Annotated[Finite, BeforeValidator(_no_boolean)]
Gain = Annotated[Positive, BeforeValidator(_no_boolean)]
Seed = Annotated[int, Field(ge=0, lt=2**63), BeforeValidator(_no_boolean)]


class Model(BaseModel):
    """Frozen, and says so when a key is unknown."""

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)


class Ramp(Model):
    """ν_β(t) = min(from + rate·t, to): the paper's cure for overflow at the start (section IV-F).

    Attributes:
        start: ν_β(0), written ``from`` in a file; 1/ψ.
        to: its final value, 1/ψ.
        rate: 1/(ψ s).
    """

    start: Gain = Field(alias="from")
    to: Gain
    rate: Gain

    @model_validator(mode="after")
    def _rises(self) -> Ramp:
        if self.to < self.start:
            raise ValueError(f"rises from {self.start:g} to {self.to:g}; `to` must not be below `from`")
        return self


class Smoothing(Model):
    """ν_α and ν_β of the soft minima (paper, eq. 7 and 9), in units of 1/ψ."""

    nu_alpha: Gain
    nu_beta: Gain | Ramp


class Start(Model):
    """Where starts and first estimates are drawn, if not given.

    Attributes:
        box: ``[low, high]``, numbers for all axes alike or one list each; None lets the scale of the constraints decide.
        seed: of the draw.
    """

    box: tuple[Number, Number] | tuple[tuple[Number, ...], tuple[Number, ...]] | None = None
    seed: Seed = 0

    @model_validator(mode="after")
    def _ordered(self) -> Start:
        if self.box is not None:
            low, high = (side if isinstance(side, tuple) else (side,) for side in self.box)
            if len(low) != len(high) or not all(a <= b for a, b in zip(low, high, strict=True)):
                raise ValueError(f"box is {[list(s) if isinstance(s, tuple) else s for s in self.box]}, but must be [low, high] with low ≤ high")
        return self


class ProtocolSettings(Model):
    """Which protocol, over which estimates, with which gains.

    Attributes:
        kind: a key of `consat.protocols.FLOWS`; None for the default.
        estimates: who holds copies: ``local`` what is needed, ``full`` everything (the paper).
        k1: gain on the gradient.
        k2: gain on the disagreement.
    """

    kind: str | None = None
    estimates: Literal["local", "full"] = "local"
    k1: Gain | None = None
    k2: Gain | None = None


class Settings(Model):
    """All of it, with the defaults that apply where nobody says otherwise."""

    start: Start = Start()
    protocol: ProtocolSettings = ProtocolSettings()
    smoothing: Smoothing | Literal["auto"] = "auto"
    until: Gain | None = None
    rounds: Annotated[int, Field(ge=0)] | None = None
    stop: Literal["satisfied", "converged", "never"] | None = None
