"""Whole periods that contradict each other nearly everywhere: which change of the declared sequence would end that?"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from planish.errors import InputError
from planish.measurement import View, rejection_bit
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import AxisCode, Layout, PeriodSteps, make_axis_code
from planish.sensing.checks.direction import backward_share
from planish.sensing.decode import DecodeOptions, PhaseMap
from planish.sensing.decode.gray import Contradiction
from planish.sensing.observe import Observation, observe

#: Among the pixels that show fringes, slips are rare (beside edges, in noise): a larger share is no accident.
MAX_SLIP_SHARE = 0.3
#: Inter-reflection alone is no contradiction; beside so many slips it is one.
MIN_SLIP_SHARE = 0.1
#: Fewer lit pixels than this share of the image say nothing.
MIN_LIT_SHARE = 0.01
#: A change of the sequence explains the slips where it leaves less than this share of them.
EXPLAINED = 0.3
#: Every so many rows and columns are counted.
COUNTED_EVERY = 4
#: Shorter periods no projector shows.
MIN_PERIOD_PX = 2.0
#: Every so many rows and columns serve to try it.
SAMPLE_STRIDE = 3


def slip_share(phase: PhaseMap, view: View, code: AxisCode) -> float:
    """Return the share of contradictions among the pixels whose fringes are clear enough; 0 where next to none are.

    A wrong sequence makes differences of any size: those of less than a slip look like inter-reflection.
    """
    every = np.s_[::COUNTED_EVERY, ::COUNTED_EVERY]
    reasons = phase.rejected[every]
    unlit = rejection_bit("dark") | rejection_bit("saturated") | rejection_bit("masked")
    slip, other = rejection_bit("slip"), rejection_bit("interreflection")
    shown = (reasons & unlit) == 0
    if code.ladder is not None and view.mean is not None and view.modulation is not None:
        # Where noise alone makes slips, they contradict nothing.
        noise = np.sqrt(view.noise.variance(view.mean[every]))
        with np.errstate(divide="ignore"):
            shown &= noise / view.modulation[every] < code.ladder.noise_limit
    if shown.mean() <= MIN_LIT_SHARE:
        return 0.0
    slips = float(((reasons[shown] & slip) != 0).mean())
    return slips if slips < MIN_SLIP_SHARE else float(((reasons[shown] & (slip | other)) != 0).mean())


def worst_share(seen: Mapping[str, Observation], layout: Layout) -> float:
    """Return the largest share of slips, or of positions that run back and forth, of all cameras and axes."""
    codes, shares = {code.axis: code for code in layout.codes}, [0.0]
    for item in seen.values():
        shares += [slip_share(phase, item.view, codes[axis]) for axis, phase in item.phases.items()]
        # Periods that are absolute by themselves contradict each other.
        counted = [code for code in layout.codes if code.gray is not None and len(code.periods) == 1]
        shares += [backward_share(item.phases[code.axis], code.periods[0].period_px) for code in counted]
    return max(shares)


def observe_consistent(
    take: Callable[[str], Sequence[GreyImage]], again: Callable[[str], Sequence[GreyImage]], cameras: Sequence[str],
    layout: Layout, options: DecodeOptions, subject: str, threads: int,
) -> dict[str, Observation]:  # fmt: skip
    """Return what each camera saw, as `observe` does.

    Parameters
    ----------
    take, cameras, layout, options, subject, threads
        As in `observe`.
    again : callable
        Returns the images of a camera once more, to try other sequences with.

    Raises
    ------
    InputError
        Where coarse and fine positions contradict each other nearly everywhere; it says which sequence would fit.
    """
    try:
        seen = observe(take, cameras, layout, options, subject, threads)
        share = worst_share(seen, layout)
    except Contradiction:
        seen, share = {}, 1.0
    if share <= MAX_SLIP_SHARE:
        return seen
    hint = explain({name: again(name) for name in cameras}, layout, options, share, subject, threads)
    where = "nearly everywhere" if not seen else f"in {100 * share:.0f} % of the lit pixels"
    raise InputError(
        f"{subject}: sequence",
        f"coarse and fine patterns contradict each other {where}",
        f"{hint}: so the images fit" if hint else "the periods, signs, steps and bits with which the images were taken",
    )


def explain(
    images: Mapping[str, Sequence[GreyImage]], layout: Layout, options: DecodeOptions, share: float, subject: str,
    threads: int,
) -> str:  # fmt: skip
    """Return in words the change of the declared sequence that makes the images fit, or nothing."""
    few = {name: [_thinned(image) for image in stack] for name, stack in images.items()}
    best, said = EXPLAINED * share, ""
    for words, changed in _changes(layout):
        try:
            codes = (make_axis_code(c.axis, c.periods, c.gray, c.extent_px, subject) for c in changed.codes)
            changed = replace(changed, codes=tuple(codes))
            seen = observe(few.__getitem__, list(few), changed, options, subject, threads)
        except InputError:
            continue
        left = worst_share(seen, changed)
        if left < best:
            best, said = left, words
    return said


def _thinned(image: GreyImage) -> GreyImage:
    thin: GreyImage = image[::SAMPLE_STRIDE, ::SAMPLE_STRIDE].copy()
    return thin


def _changes(layout: Layout) -> Iterator[tuple[str, Layout]]:
    for number, code in enumerate(layout.codes):
        for words, changed in _code_changes(code):
            yield (
                f"{words} (axis {code.axis})",
                replace(layout, codes=(*layout.codes[:number], changed, *layout.codes[number + 1 :])),
            )


def _code_changes(code: AxisCode) -> Iterator[tuple[str, AxisCode]]:
    periods = code.periods
    if periods:
        turned = tuple(_turned(p) for p in periods)
        yield f"sign {turned[0].sign} for all periods", replace(code, periods=turned)
    for k, period in enumerate(periods):
        name = f"period {period.period_px:g} px"
        yield f"sign {-period.sign} for {name}", _with(code, k, _turned(period))
        for by in range(1, len(period.images)):
            images = period.images[by:] + period.images[:by]
            yield f"step 0 of {name} at its image number {by}", _with(code, k, replace(period, images=images))
        for j in range(k):
            other = periods[j]
            if len(other.images) == len(period.images):
                exchanged = _with(code, k, replace(period, images=other.images))
                yield (
                    f"the images of periods {other.period_px:g} and {period.period_px:g} px exchanged",
                    _with(exchanged, j, replace(other, images=period.images)),
                )
    if code.gray is not None:
        gray = code.gray
        if len(gray.images) > 1:
            backwards = replace(gray, images=gray.images[::-1], inverse=gray.inverse[::-1])
            yield "Gray bits in the reverse order", replace(code, gray=backwards)
        for factor in (0.5, 2.0):
            yield f"cell_px {factor * gray.cell_px:g}", replace(code, gray=replace(gray, cell_px=factor * gray.cell_px))
        if min(gray.inverse) >= 0:
            swapped = replace(gray, images=gray.inverse, inverse=gray.images)
            yield "Gray bits and their inverses exchanged", replace(code, gray=swapped)
    yield from _other_periods(code)


def _other_periods(code: AxisCode) -> Iterator[tuple[str, AxisCode]]:
    """Yield periods that a slip of the pen may have meant: whole pixels nearby, the nearest first, halves, doubles."""
    first = int(code.gray is None)  # the longest period has nothing to contradict it
    for by in (-1, 1, -2, 2, -3, 3, -4, 4, None):
        for k, period in enumerate(code.periods[first:], first):
            px = period.period_px
            for other in (px / 2, 2 * px) if by is None else (round(px) + by,):
                if other >= MIN_PERIOD_PX and other != px:
                    changed = _with(code, k, replace(period, period_px=float(other)))
                    yield f"a period of {other:g} instead of {px:g} px", changed


def _turned(period: PeriodSteps) -> PeriodSteps:
    return replace(period, sign=-period.sign)


def _with(code: AxisCode, k: int, period: PeriodSteps) -> AxisCode:
    return replace(code, periods=(*code.periods[:k], period, *code.periods[k + 1 :]))
