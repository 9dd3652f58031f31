"""What one image of a sequence shows: white, black, a phase step, a Gray bit, a statistical pattern."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, model_validator

from planish.options import Strict

Axis = Literal["u", "v"]


class _Shown(Strict):
    """`exposure_ms` is given where a sequence is repeated with several exposures, to all of its entries."""

    exposure_ms: PositiveFloat | None = None


class White(_Shown):
    """Every projector pixel on."""

    role: Literal["white"]


class Black(_Shown):
    """Every projector pixel off."""

    role: Literal["black"]


class Phase(_Shown):
    """One step of a phase shift: I = A + B cos(phi - sign 2 pi step / steps), phi = 2 pi u / period_px.

    `wave` "square" is a square wave shifted in equal steps, read as if it were a cosine.
    """

    role: Literal["phase"]
    axis: Axis = "u"
    period_px: PositiveFloat
    step: int = Field(ge=0)
    steps: int = Field(ge=3)
    sign: Literal[1, -1] = 1
    wave: Literal["sine", "square"] = "sine"

    @model_validator(mode="after")
    def _step_in_range(self) -> Self:
        if self.step >= self.steps:
            raise ValueError(f"step {self.step} must be below steps = {self.steps}")
        return self


class Gray(_Shown):
    """One bit of the reflected Gray code of the cell index; bit b has weight 2^b; cell k starts at pixel k cell_px.

    With cells of half a fringe period the lowest bit is what is known as the complementary bit.
    """

    role: Literal["gray"]
    axis: Axis = "u"
    bit: int = Field(ge=0, le=15)
    inverse: bool = False
    cell_px: PositiveFloat = 1.0


class Statistical(_Shown):
    """One of many different aperiodic patterns; what it looks like need not be known to correlate two cameras.

    planish's own are stripes along one projector axis, made of `seed` and `index` (sensing/patterns/statistical.py).
    """

    role: Literal["statistical"]
    axis: Axis = "u"
    index: int = Field(ge=0)
    seed: int = Field(default=1, ge=0)
    min_period_px: PositiveFloat = 12.0


Entry = Annotated[White | Black | Phase | Gray | Statistical, Field(discriminator="role")]
