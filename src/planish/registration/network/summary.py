"""What the network found out about itself: loops, drift, what nothing would notice, what was given from outside."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from planish.options import Strict

Matrix = list[list[float]]


class Loop(Strict):
    """A closed walk along used pairs: the product of their transforms against no motion at all.

    The closure is that of the pairs as they were measured, at the overlap of the first and the last; `predicted_mm` is
    its standard deviation, all directions together; `sigma` the root of its quadratic form over six; `adjusted_mm` the
    largest residual that the adjustment leaves in one of its pairs.
    """

    measurements: tuple[str, ...]
    closure_mm: float
    closure_rad: float
    predicted_mm: float
    sigma: float
    adjusted_mm: float


class Tie(Strict):
    """A pair in use: how much of it others control, and the least shift at which it would be taken out.

    `redundancy` is 0 where nothing would notice an error of the pair, near 1 where many others say the same;
    `detectable_mm` is None where a direction of it is not controlled at all.
    """

    a: str
    b: str
    redundancy: float
    detectable_mm: float | None
    residual_mm: float


class Place(Strict):
    """How far a measurement is from the reference of its group, in pairs, and what the way does to it.

    `chain_sigma_mm` is the standard deviation of its place along the most certain chain of pairs, `chain_mm` how far
    that chain puts it from the adjusted place (drift), `sigma_mm` the standard deviation of the adjusted place.
    """

    name: str
    pairs_from_reference: int
    chain_mm: float
    chain_sigma_mm: float
    sigma_mm: float


class Advice(Strict):
    """The pair that came closest to tying two groups together, and why it was not accepted."""

    groups: tuple[int, int]
    a: str
    b: str
    log10_false_alarms: float
    reason: str


class GivenTest(Strict):
    """One thing given from outside, against all others: `used` or, with a reason, left out."""

    kind: Literal["point", "robot", "surface"]
    measurement: str
    target: str | None
    used: bool
    residual_mm: float
    sigma: float
    redundancy: float
    reason: str | None


class Frame(Strict):
    """A frame given from outside, in the world of a group; what nothing holds of it is said in `not_held`."""

    group: int
    kind: Literal["given", "robot"]
    T_world_frame: Matrix
    is_world: bool
    not_held: tuple[str, ...] = ()


class NetworkSummary(Strict):
    """All of it, and the sentences that a reader must not miss."""

    variance_factors: dict[str, float] = Field(default_factory=dict)
    loops: tuple[Loop, ...] = ()
    ties: tuple[Tie, ...] = ()
    places: tuple[Place, ...] = ()
    advice: tuple[Advice, ...] = ()
    given: tuple[GivenTest, ...] = ()
    frames: tuple[Frame, ...] = ()
    warnings: tuple[str, ...] = ()
