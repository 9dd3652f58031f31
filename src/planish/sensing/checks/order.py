"""The declared sequence against the images: order of the steps, light that changes with the patterns, saturation.

All of it follows from one small matrix: the products of all images of the sequence, summed over some pixels. The
residual of any order of the steps is a quadratic form of it, so that hundreds of orders are tried at no cost.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray

from planish.errors import InputError
from planish.geometry import Array
from planish.measurement import Finding, NoiseModel
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import Layout, PeriodSteps

#: Pixels that are looked at.
SAMPLED_PX = 10_000
#: The residual (rms) is compared with the amplitude of the fringes. Square waves leave 0.28, gamma 2.2 leaves 0.20 to
#: 0.29, any wrong order of four or five steps more than 0.5.
WARN_RESIDUAL, MAX_RESIDUAL = 0.35, 0.6
#: Residuals below this many times the noise's variance are noise.
NOISE_RATIO = 4.0
#: Another order explains the images where it leaves less than this share of the declared order's residual power.
BETTER = 0.25
#: All orders are tried up to so many steps, exchanges of two beyond.
ALL_ORDERS_STEPS = 6
#: Where fewer pixels than this share show the fringes, or are not saturated, nothing was measured.
MIN_SHARE = 1e-3
#: What decoding needs: standard deviation of the phase [rad].
MAX_PHASE_SIGMA_RAD = 0.25


@dataclass(frozen=True)
class Sample:
    """Grey values of some pixels.

    Parameters
    ----------
    grey : ndarray (images, pixels) float32
        Pixels that are not saturated in any phase image.
    saturated : float
        Share of the pixels that are.
    """

    grey: NDArray[np.float32]
    saturated: float


def sample(images: Sequence[GreyImage], layout: Layout, saturation: float) -> Sample:
    """Return the grey values of evenly spread pixels."""
    # Whole stretches of few rows: pixels side by side cost one access to memory.
    across = 2
    down = max(1, images[0].size // (across * SAMPLED_PX))
    grey = np.stack([np.asarray(image[down // 2 :: down, ::across], np.float32).ravel() for image in images])
    bright = (grey[list(layout.phase_images)] >= saturation).any(0)
    return Sample(grey[:, ~bright], float(bright.mean()))


def check_order(
    images: Sequence[GreyImage], layouts: Sequence[Layout], noise: NoiseModel, saturation: float, camera: str,
    subject: str,
) -> tuple[Finding, ...]:  # fmt: skip
    """Return what the fit residuals of all periods say about the declared sequence.

    Raises
    ------
    InputError
        Where no fringes are seen, all is saturated, or the images are in another order than declared.
    """
    findings: list[Finding] = []
    for layout in layouts:
        if not layout.periods:
            continue
        pixels = sample(images, layout, saturation)
        # One exposure of several may be all dark or all bright: that is what the others are for.
        _require_fringes(pixels, layout, noise, camera, subject, strict=layout.exposure_ms is None)
        if pixels.grey.shape[1] == 0:
            continue
        products = _products(pixels.grey, layout)
        for period in (p for p in layout.periods if len(p.images) > 3):
            findings.append(_check_period(products, layout, period, pixels, noise, camera, subject))
    # One line per camera: the worst period.
    return (max(findings, key=lambda finding: finding.value or 0.0),) if findings else ()


def _require_fringes(
    pixels: Sample, layout: Layout, noise: NoiseModel, camera: str, subject: str, strict: bool
) -> None:
    if not strict:
        return
    if pixels.saturated > 1 - MIN_SHARE:
        raise InputError(
            subject,
            f"camera {camera}: {100 * pixels.saturated:.1f} % of the pixels are saturated in some phase step",
            "less light or a shorter exposure: at least three steps below saturation",
        )
    period = layout.periods[-1]
    amplitude = _amplitude(pixels.grey, period)
    mean = pixels.grey[list(period.images)].mean(0)
    sigma = np.sqrt(2 / len(period.images) * np.maximum(noise.offset + noise.slope * mean, 1 / 12))
    needed = sigma / MAX_PHASE_SIGMA_RAD
    if (amplitude > needed).mean() < MIN_SHARE:
        raise InputError(
            subject,
            f"camera {camera}: no fringes of {period.period_px:g} px; their amplitude is "
            f"{np.quantile(amplitude, 0.99):.2g} grey levels in the best hundredth of the pixels",
            f"{np.median(needed):.2g} grey levels and more: is the projector on, does it change the pattern with each "
            "image, and is the camera triggered by it?",
        )


def _products(grey: NDArray[np.float32], layout: Layout) -> Array:
    """Return the products (images, images) of all images, over the pixels where the finest fringes have contrast."""
    period = layout.periods[-1]
    # By contrast, not by the amplitude of the fit: in a wrong order that vanishes where the fit is worst.
    contrast = np.ptp(grey[list(period.images)], axis=0)
    clear = contrast > 0.3 * np.quantile(contrast, 0.95)
    # Products of 16 bits in single precision would leave more of a right order than fine rounding does.
    shown = grey[:, clear].astype(float)
    return np.asarray(shown @ shown.T, float) / max(int(clear.sum()), 1)


def _amplitude(grey: NDArray[np.float32], period: PeriodSteps) -> NDArray[np.float32]:
    steps = grey[list(period.images)]
    waves = np.stack([np.cos(period.angles), np.sin(period.angles)]).astype(np.float32) @ steps
    return np.asarray(np.hypot(*waves) * (2 / len(steps)), np.float32)


def residual_power(
    products: Array, images: Sequence[int], angles: Array, harmonics: Sequence[int] = (1,)
) -> tuple[float, float]:
    """Return the residual's variance per degree of freedom and half the squared amplitude (mean over the pixels).

    `images[k]` is taken as step k; the fringes may hold these `harmonics` of the cosine.
    """
    part = products[np.ix_(list(images), list(images))]
    steps = len(images)
    shown = _harmonics(tuple(angles), tuple(harmonics))
    power = np.einsum("ki,ij,kj->k", shown, part, shown)
    left = float(np.trace(part) - power.sum())
    return max(left, 0.0) / (steps - len(shown)), float(power[1:3].sum()) / steps


@lru_cache(maxsize=64)
def _harmonics(angles: tuple[float, ...], harmonics: tuple[int, ...]) -> Array:
    """Return an orthonormal basis (n, steps) of a constant and harmonics of the cosine."""
    theta = np.array(angles)
    rows = [np.ones(len(theta))]
    for h in harmonics:
        rows += [np.cos(h * theta), np.sin(h * theta)]
    # At half the number of steps the sine vanishes.
    return np.array([row / np.linalg.norm(row) for row in rows if np.linalg.norm(row) > 1e-6])


def _families(steps: int) -> list[tuple[int, ...]]:
    """Return sets of harmonics that real fringes hold: none but the first, odd ones (square waves), two (gamma)."""
    odd = tuple(range(1, steps // 2 + 1, 2))
    return [family for family in dict.fromkeys(((1,), odd, (1, 2))) if 2 * len(family) + 1 < steps or family == (1,)]


def _check_period(
    products: Array, layout: Layout, period: PeriodSteps, pixels: Sample, noise: NoiseModel, camera: str, subject: str
) -> Finding:
    steps = len(period.images)
    left, signal = residual_power(products, period.images, period.angles)
    mean = float(pixels.grey[list(period.images)].mean())
    variance = max(noise.offset + noise.slope * mean, 1 / 12)
    # Rms of the residual per image, noise taken off, against the amplitude.
    share = float(np.sqrt(max(left - variance, 0.0) * (steps - 3) / steps / max(2 * signal, 1e-12)))
    name = f"period {period.period_px:g} px, camera {camera}"
    warning = ""
    if left > NOISE_RATIO * variance:
        found = _better_list(products, layout) or _better_order(products, period, variance)
        if found:
            raise InputError(subject, f"camera {camera}: {found}", "the order of the sequence in capture.json")
        if share > MAX_RESIDUAL:
            raise InputError(
                subject,
                f"{name}: the images fit {steps} steps of a phase shift in no order; the residual is "
                f"{100 * share:.0f} % of the fringes' amplitude",
                f"a residual below {100 * WARN_RESIDUAL:.0f} %: are the images listed those of the sequence?",
            )
        if share > WARN_RESIDUAL:
            warning = f"{name}: the phase steps fit badly (residual {100 * share:.0f} % of the fringes' amplitude)"
    return Finding(f"residual of the phase steps in camera {camera}", 100 * share, None, "% of the amplitude",
                   f"period {period.period_px:g} px", warning)  # fmt: skip


def _better_list(products: Array, layout: Layout) -> str:
    """Return in words which order of the whole list of images fits all periods, or nothing."""
    count = len(products)
    periods = [p for p in layout.periods if len(p.images) > 3]

    def power(place: Sequence[int]) -> tuple[float, float]:
        fits = [residual_power(products, [place[i] for i in p.images], p.angles) for p in periods]
        return sum(fit[0] for fit in fits), min(fit[1] for fit in fits)

    left, _ = power(range(count))
    # Images without fringes leave no residual either: every period needs its signal.
    signal = 0.5 * float(np.median([residual_power(products, p.images, p.angles)[1] for p in periods]))
    tried: list[tuple[str, list[int]]] = []
    for moved in range(1, count):
        by = moved if moved <= count // 2 else moved - count
        words = f"the images stand {abs(by)} places {'later' if by > 0 else 'earlier'} in the list than declared"
        tried.append((words, [(i + moved) % count for i in range(count)]))
    for first in (0, 1):
        text = [k - first for k in sorted(range(first, count + first), key=str)]
        words = "the images are listed with their numbers sorted as text (1, 10, 11, ..., 2)"
        tried.append((words, [text.index(i) for i in range(count)]))
    fits = [(*power(place), words) for words, place in tried]
    good = [(rest, words) for rest, strength, words in fits if rest < BETTER * left and strength > signal]
    return min(good)[1] if good else ""


def _better_order(products: Array, period: PeriodSteps, variance: float) -> str:
    """Return in words which order of the steps fits the images of a period, or nothing."""
    steps = len(period.images)
    orders = list(_orders(steps))
    # order[j] is the step that image j shows.
    listed = [[period.images[order.index(k)] for k in range(steps)] for order, _ in orders]
    plain = [residual_power(products, images, period.angles)[0] for images in listed]
    for family in _families(steps):
        # Square waves leave so much over that an exchange of two of twelve steps drowns in it: other families follow.
        left = residual_power(products, period.images, period.angles, family)[0]
        if left < NOISE_RATIO * variance:
            continue
        good = [
            k for k, images in enumerate(listed)
            if residual_power(products, images, period.angles, family)[0] < BETTER * left
        ]  # fmt: skip
        if good:
            order, name = orders[min(good, key=lambda k: plain[k])]
            steps_text = " ".join(str(k) for k in order) + f" ({name})" if name else _like_declared(order)
            return f"the images of period {period.period_px:g} px fit the order {steps_text}"
    return ""


def _orders(steps: int) -> Iterator[tuple[tuple[int, ...], str]]:
    """Yield orders of the steps, with a name or "": all of a few steps, else sorted, interleaved, single exchanges."""
    natural = list(range(steps))
    for first in (0, 1):
        yield tuple(k - first for k in sorted(range(first, steps + first), key=str)), "numbers sorted as text"
    if steps <= ALL_ORDERS_STEPS:
        # The first image may be called step 0, and a reversed order only turns the sign.
        yield from (((0, *rest), "") for rest in permutations(natural[1:]) if rest[0] < rest[-1])
        return
    for stride in range(2, steps):
        yield tuple(k for start in range(stride) for k in range(start, steps, stride)), ""
    for a, b in combinations(natural, 2):
        order = natural.copy()
        order[a], order[b] = order[b], order[a]
        yield tuple(order), ""
    for a in natural:
        for b in natural:
            order = natural[:a] + natural[a + 1 :]
            order.insert(b, a)
            yield tuple(order), ""


def _like_declared(order: tuple[int, ...]) -> str:
    """Return an order as text: of all that leave the same residual the one most like the declared one."""
    steps = np.array(order)
    count = len(order)
    alike: list[NDArray[np.int64]] = [(sign * steps + shift) % count for sign in (1, -1) for shift in range(count)]
    return " ".join(str(k) for k in max(alike, key=lambda o: int((o == np.arange(count)).sum())))
