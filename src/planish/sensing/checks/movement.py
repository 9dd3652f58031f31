"""Movement of part or sensor during a sequence, in camera pixels with its standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from planish.errors import InputError
from planish.geometry import Array
from planish.measurement import Finding, Map, NoiseModel
from planish.sensing.capture.images import GreyImage
from planish.sensing.capture.sequence import Layout, PeriodSteps
from planish.sensing.checks.light import Band, EqualLight, equal_light, to_adapt
from planish.sensing.checks.shift import BLOCK_PX, FLOOR_GAIN, NOT_OBSERVABLE, BlockSums, Shift, block_sums, solve_shift
from planish.sensing.checks.still import (
    Still,
    comparable,
    mean_of,
    projector_light,
    stills,
    to_compare,
    white_to_compare,
)

#: A capture with more movement [px] is refused: points and texture would be off by more than their own noise.
MAX_MOVEMENT_PX = 0.2
#: Movements known less well [px] are not observable: there is too little texture.
MAX_SIGMA_PX = 0.1
#: ... where it exceeds that by so many standard deviations.
REFUSE_SIGMAS = 3.0
#: Where no black image shows the room's light, highlights and reflections let texture look shifted where the light
#: differs, by so much per logarithm of its ratio (two cameras on blank steel, fringes against white: 0.07 px, with the
#: black image 0.006 px).
LIGHT_SIGMA_PX = 0.08
#: A part of the image moves where its shift differs from nothing by so many standard deviations.
LOCAL_SIGMAS = 5.0
#: Side of the windows [blocks] that are looked at one by one, and of the tiles in them that have to agree.
WINDOW_BLOCKS, TILE_BLOCKS = 8, 4
#: Image pixels that are looked at, in bands of whole windows: enough for 0.02 px on grain of 0.5 % contrast.
SAMPLED_PX = 200_000
#: The fit residual is a second witness only.
DRIFT_PX = 60_000
#: Bins of the phase for what repeats with it.
PHASE_BINS = 48
#: Contrast of the patterns, in standard deviations of a grey value, that shows that a pixel is lit.
LIT_SIGMAS = 6.0
#: Periods beyond this share of the projector are long: a window sees a part of one.
LONG_SHARE = 0.1
#: ... and the movement shows where the light, weighted by its time, is at least this share of the mean.
SEEN_LIGHT = 0.3
#: Movements beyond one pixel are followed in images of a quarter of the size.
COARSE = 4
COARSE_FROM_PX = 1.0


@dataclass(frozen=True)
class Movement:
    """What moved: globally, and the window that moved most."""

    everywhere: Shift
    local: Shift | None
    place_px: tuple[int, int] | None

    @property
    def worst(self) -> Shift:
        """The one of the two that is more surely too large."""
        if self.local is None:
            return self.everywhere
        return max(self.everywhere, self.local, key=lambda shift: shift.sigmas_beyond(MAX_MOVEMENT_PX))


def check_movement(
    images: Sequence[GreyImage], layouts: Sequence[Layout], noise: NoiseModel, saturation: float, camera: str,
    subject: str, threads: int,
) -> tuple[Finding, ...]:  # fmt: skip
    """Return what the images (H, W) of a camera say about movement between the first and the last of them.

    Raises
    ------
    InputError
        Where the movement is larger than MAX_MOVEMENT_PX.
    """

    def ask(pair: tuple[Still, Still], quantity: str) -> Finding:
        first, last = pair
        found = compare(images, first, last, noise, saturation, threads)
        return _judge(found, quantity, f"{first.name} against {last.name}", subject)

    quantity, groups = f"movement in camera {camera}", stills(layouts)
    finding = Finding(quantity, None, None, "px", "no two groups of images show the same picture")
    for pair in to_compare(groups):
        finding = ask(pair, quantity)
        if finding.value is not None:
            break
    findings = [finding]
    white = white_to_compare(groups)
    if white is not None:
        findings.append(ask(white, f"movement between patterns and white, camera {camera}"))
    witness = _witness(layouts)
    if witness is not None:
        steps, long = witness
        found = drift(images, steps, long, noise, saturation, threads)
        name = f"the {len(steps.images)} steps of {steps.period_px:g} px"
        findings.append(_judge(found, f"movement within {name}, camera {camera}", f"fit residual of {name}", subject))
    return tuple(findings)


def compare(
    images: Sequence[GreyImage], first: Still, last: Still, noise: NoiseModel, saturation: float, threads: int
) -> Movement:
    """Return the movement of the last group of images against the first."""
    rows = bands(images[0].shape, SAMPLED_PX, WINDOW_BLOCKS)
    tops, coarse, light = [band.start for band in rows], None, None
    if not (first.lit_only or last.lit_only):
        coarse, light = _compare_coarse(images, first, last, noise, saturation, threads)
    sums, _ = _sums(images, first, last, rows, noise, saturation, threads, light)
    fine = _under_other_light(locate(sums, tops), first, last)
    return coarse if coarse is not None and coarse.worst.length_px > COARSE_FROM_PX else fine


def _sums(
    images: Sequence[GreyImage], first: Still, last: Still, parts: Sequence[slice], noise: NoiseModel,
    saturation: float, threads: int, light: EqualLight | None = None,
) -> tuple[list[BlockSums], EqualLight]:  # fmt: skip
    """Return the sums of two groups under the same light over some bands of rows, and that light, unless it is known.

    What fringes show of the projector's light is less of it where they are blurred or light comes by several ways: it
    is made use of where it explains more than a common factor does.
    """
    adapted = to_adapt(first, last) if light is None or light.of is not None else None
    seen = []
    for rows in parts:
        means = mean_of(images, first.images, rows), mean_of(images, last.images, rows)
        usable = comparable(images, first, last, means, rows, _contrast_limit(means[0], noise), saturation)
        shown = None if adapted is None else projector_light(images, adapted, rows)
        seen.append(Band(*means, None, usable) if shown is None else Band(*means, shown[0], usable & shown[1]))
    lights = [equal_light(seen, first, last) if light is None else light]
    if light is None and adapted is not None and not adapted.exact_swings:
        lights.append(EqualLight())
    found = []
    for light in lights:
        shares = light.shares(first, last)
        found.append(([block_sums(*light.means(band), band.usable, noise, shares, threads) for band in seen], light))
    return min(found, key=lambda item: _unlike(item[0]))


def _unlike(sums: Sequence[BlockSums]) -> float:
    """Return how much more two groups differ than by noise, as a share of the texture's power."""
    texture = sum(float(part.normal[..., 2, 2].sum()) for part in sums)
    excess = sum(float((part.power - FLOOR_GAIN[2] * part.variance).sum()) for part in sums)
    return excess / max(texture, 1e-9)


def _under_other_light(found: Movement, first: Still, last: Still) -> Movement:
    if first.exact_swings or last.exact_swings:
        return found
    more = (LIGHT_SIGMA_PX * float(np.log(last.light / first.light))) ** 2 * np.eye(2)
    everywhere = replace(found.everywhere, covariance=found.everywhere.covariance + more)
    local = None if found.local is None else replace(found.local, covariance=found.local.covariance + more)
    return replace(found, everywhere=everywhere, local=local)


def drift(
    images: Sequence[GreyImage], steps: PeriodSteps, long: bool, noise: NoiseModel, saturation: float, threads: int
) -> Movement:
    """Return the steady movement over the steps of one period, from what the fit of the fringes leaves over.

    Notes
    -----
    I_k = A(x - s k / (N - 1)) + B cos(phi - angle_k): the weights w with sum w_k (1, cos, sin)(angle_k) = 0 and
    sum w_k k / (N - 1) = 1 leave -s . grad A. Harmonics of the fringes are taken off as a function of the phase. The
    texture is lit by the fringes: what moves is sum w_k k / (N - 1) I_k, which is A where fringes are short against a
    window (they average out in it), but not where they are `long`.
    """
    weights, time = drift_weights(steps)
    share = float(weights @ weights) / 2
    sums, tops = [], []
    group = Still(steps.images, "")
    for rows in bands(images[0].shape, DRIFT_PX, TILE_BLOCKS):
        mean = mean_of(images, steps.images, rows)
        ramp, shown = np.zeros_like(mean), np.zeros_like(mean)
        for index, weight, when in zip(steps.images, weights, time, strict=True):
            ramp += np.float32(weight / 2) * images[index][rows]
            if long:
                shown += np.float32(weight * when) * images[index][rows]
        if not long:
            shown = mean
        ramp -= _wave_form(ramp, images, steps, rows)
        usable = comparable(images, group, group, (mean, mean), rows, _contrast_limit(mean, noise), saturation)
        if long:
            # Where the weighted light is next to nothing, the movement cannot be seen.
            usable &= (cv2.blur(shown, (BLOCK_PX, BLOCK_PX)) > np.float32(SEEN_LIGHT) * mean).view(np.uint8)
        sums.append(block_sums(shown - ramp, shown + ramp, usable, noise, (share, share), threads))
        tops.append(rows.start)
    # Harmonics of the fringes may look like a movement of a window; over the image they average out. Where they are
    # most of what is left, nothing is known.
    found = replace(locate(sums, tops), local=None, place_px=None)
    return replace(found, everywhere=NOT_OBSERVABLE) if found.everywhere.unexplained else found


def _wave_form(left: Map, images: Sequence[GreyImage], steps: PeriodSteps, rows: slice) -> Map:
    """Return the part of what is left over (h, W) that repeats with the phase: fringes that are no cosine."""
    cosine, sine = np.zeros_like(left), np.zeros_like(left)
    for index, angle in zip(steps.images, steps.angles, strict=True):
        grey = images[index][rows].astype(np.float32)
        cosine += np.float32(2 / len(steps.images) * np.cos(angle)) * grey
        sine += np.float32(2 / len(steps.images) * np.sin(angle)) * grey
    amplitude = np.hypot(cosine, sine)
    place = (np.arctan2(sine, cosine) * (PHASE_BINS / (2 * np.pi))).astype(np.int64) % PHASE_BINS
    # Least squares of left = amplitude * form(phase) in each bin.
    power = np.bincount(place.ravel(), (amplitude * amplitude).ravel(), PHASE_BINS)
    form = np.bincount(place.ravel(), (amplitude * left).ravel(), PHASE_BINS) / np.maximum(power, 1e-9)
    return np.asarray(amplitude * form[place], np.float32)


def drift_weights(steps: PeriodSteps) -> tuple[Array, Array]:
    """Return weights (N,) of the steps that see a steady movement and no fringes, and the time (N,) from 0 to 1."""
    time = np.asarray(steps.images, float)
    time = (time - time.min()) / (time.max() - time.min())
    fringes = np.stack([np.ones(len(time)), np.cos(steps.angles), np.sin(steps.angles)], -1)
    left = time - fringes @ np.linalg.lstsq(fringes, time, rcond=None)[0]
    return np.asarray(left / (left @ time)), time


def bands(shape: tuple[int, ...], pixels: int, blocks: int) -> list[slice]:
    """Return bands of rows, so many blocks high and evenly spread, that together hold about so many pixels."""
    side = min(blocks * BLOCK_PX, shape[0])
    count = max(1, min(shape[0] // side, round(pixels / (side * shape[1]))))
    starts = np.linspace(0, shape[0] - side, count + 2)[1:-1] if count < shape[0] // side else np.arange(count) * side
    return [slice(int(start), int(start) + side) for start in starts]


def locate(sums: Sequence[BlockSums], tops: Sequence[int], pixel: int = 1) -> Movement:
    """Return the movement of all blocks together, and that of the window that moves most.

    Parameters
    ----------
    sums : sequence of BlockSums (rows, columns)
        One per band.
    tops : sequence of int
        First row of each band [px].
    pixel : int
        Image pixels per pixel of the sums.
    """
    every = BlockSums(*(np.concatenate([getattr(s, n).reshape(-1, *getattr(s, n).shape[2:]) for s in sums])
                        for n in BlockSums.__dataclass_fields__))  # fmt: skip
    everywhere = _scaled(solve_shift(every, pixel == 1), pixel)
    best, place, surest = None, None, 0.0
    for band, top in zip(sums, tops, strict=True):
        for window, row, column in _windows(band):
            shift = _scaled(solve_shift(window, pixel == 1), pixel)
            beyond = shift.sigmas_beyond(MAX_MOVEMENT_PX)
            if beyond > surest and _apart(shift, everywhere) and _agree(window, shift, pixel):
                surest = beyond
                centre = BLOCK_PX * WINDOW_BLOCKS // 2
                best, place = shift, (pixel * (column * BLOCK_PX + centre), top + pixel * (row * BLOCK_PX + centre))
    return Movement(everywhere, best, place)


def _windows(band: BlockSums) -> list[tuple[BlockSums, int, int]]:
    rows, columns = band.power.shape
    found = []
    for row in range(0, max(rows - WINDOW_BLOCKS, 0) + 1, WINDOW_BLOCKS):
        for column in range(0, max(columns - WINDOW_BLOCKS, 0) + 1, WINDOW_BLOCKS):
            window = band[row : row + WINDOW_BLOCKS, column : column + WINDOW_BLOCKS]
            if _may_move(window):
                found.append((window, row, column))
    return found


def _may_move(window: BlockSums) -> bool:
    """Return whether the noise alone cannot explain the window: chi squared of the shift, without corrections."""
    total, right = window.normal.sum((0, 1)), window.right.sum((0, 1))
    weight = window.normal[..., 0, 0]
    if total[0, 0] <= 0 or np.linalg.det(total) <= 0:
        return False
    variance = (window.variance * weight).sum() / weight.sum() / BLOCK_PX**2
    return bool(right @ np.linalg.solve(total, right) > LOCAL_SIGMAS * variance)


def _apart(shift: Shift, everywhere: Shift) -> bool:
    """Return whether a window moves, and otherwise than the whole."""
    rest = Shift(shift.pixels - everywhere.pixels, shift.covariance + everywhere.covariance)
    moves = shift.sigmas_beyond(0.0) > LOCAL_SIGMAS
    return moves and (not everywhere.seen or rest.sigmas_beyond(0.0) > LOCAL_SIGMAS)


def _agree(window: BlockSums, shift: Shift, pixel: int) -> bool:
    """Return whether the tiles of a window move alike: a glint or a grain of dust sits in one of them."""
    along = shift.pixels / shift.length_px
    alike, known = 0, 0
    for row in range(0, window.power.shape[0], TILE_BLOCKS):
        for column in range(0, window.power.shape[1], TILE_BLOCKS):
            part = window[row : row + TILE_BLOCKS, column : column + TILE_BLOCKS]
            tile = _scaled(solve_shift(part, pixel == 1), pixel)
            sigma = float(1 / np.sqrt(along @ np.linalg.inv(tile.covariance) @ along))
            if sigma > shift.length_px / 2:
                continue
            known += 1
            alike += bool(abs(along @ tile.pixels - shift.length_px) < max(3 * sigma, 0.3 * shift.length_px))
    return known >= 2 and alike >= 0.75 * known


def _compare_coarse(
    images: Sequence[GreyImage], first: Still, last: Still, noise: NoiseModel, saturation: float, threads: int
) -> tuple[Movement, EqualLight]:
    """Return the movement at a quarter of the resolution, and how both groups came under the same light."""
    needed = tuple(dict.fromkeys(first.needed + last.needed))
    small, places = [_shrunk(images[i]) for i in needed], {index: k for k, index in enumerate(needed)}
    groups = first.renumbered(places), last.renumbered(places)
    # Averaged pixels have less noise; the rounding of their mean is as good as none.
    quiet = NoiseModel(noise.offset / COARSE**2, noise.slope / COARSE**2)
    sums, light = _sums(small, *groups, [slice(0, small[0].shape[0])], quiet, saturation, threads)
    return locate(sums, [0], COARSE), light


def _shrunk(image: GreyImage) -> GreyImage:
    height, width = (n // COARSE * COARSE for n in image.shape)
    image = image[:height, :width]
    for _ in range(2):
        image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return image


def _scaled(shift: Shift, factor: int) -> Shift:
    return Shift(factor * shift.pixels, factor**2 * shift.covariance, shift.unexplained)


def _contrast_limit(mean: Map, noise: NoiseModel) -> float:
    level = float(mean[::8, ::8].mean())
    return LIT_SIGMAS * float(np.sqrt(max(noise.offset + noise.slope * level, 1 / 12)))


def _witness(layouts: Sequence[Layout]) -> tuple[PeriodSteps, bool] | None:
    """Return the period whose fit leaves most over, and whether it is long.

    Many steps leave much over; of long fringes the harmonics are smooth.
    """
    periods = [
        (p, code.extent_px is not None and p.period_px > LONG_SHARE * code.extent_px)
        for layout in layouts
        for code in layout.codes
        for p in code.periods
        if len(p.images) > 3
    ]
    return max(periods, key=lambda item: (len(item[0].images), item[0].period_px), default=None)


def _judge(found: Movement, quantity: str, source: str, subject: str) -> Finding:
    worst = found.worst
    if worst.sigma_px > MAX_SIGMA_PX and worst.sigmas_beyond(MAX_MOVEMENT_PX) < REFUSE_SIGMAS:
        seen = f"{source}: too little texture, standard deviation {worst.sigma_px:.2g} px"
        return Finding(
            quantity, None, None, "px", seen if worst.sigma_px < 100 else f"{source}: no texture that shows it"
        )
    where = "" if worst is found.everywhere or found.place_px is None else f", around pixel {found.place_px}"
    if not worst.seen:
        where += ", across the grain; along it not observable"
    if worst.sigmas_beyond(MAX_MOVEMENT_PX) > REFUSE_SIGMAS:
        raise InputError(
            subject,
            f"{quantity}: {worst.length_px:.2f} +- {worst.sigma_px:.2f} px ({source}{where})",
            f"at most {MAX_MOVEMENT_PX} px: keep part and sensor still from the first image to the last, and take the "
            "capture again",
        )
    warning = ""
    if worst.length_px > MAX_MOVEMENT_PX:
        warning = (
            f"{quantity}: {worst.length_px:.2f} +- {worst.sigma_px:.2f} px{where}, which may be more than the "
            f"{MAX_MOVEMENT_PX} px that do no harm: make sure that nothing moves during a capture"
        )
    return Finding(quantity, worst.length_px, worst.sigma_px, "px", source + where, warning)
