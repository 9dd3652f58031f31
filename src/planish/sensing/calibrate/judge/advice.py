"""What would make a calibration better, in sentences."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath

import numpy as np

from planish.rig.parameters import PROJECTOR
from planish.sensing.calibrate.judge.coverage import REGIONS, Coverage, coverage
from planish.sensing.calibrate.judge.expected_error import ExpectedError, expected_errors, map_rms
from planish.sensing.calibrate.judge.views import Placement, depths_mm, placements
from planish.sensing.calibrate.result import Calibration

#: Below a third of its cells a region's distortion is mostly extrapolated.
REGION_SHARE = 1 / 3
#: Fewer views than this leave no redundancy to tell a bad one by.
FEW_VIEWS, ENOUGH_VIEWS = 10, 20
#: Perspective within one view, which tells focal length from distance, grows with the sine of the tilt [deg].
TILT_DEG = 25.0
#: Least standard deviation of the normals' components in the image plane: 0.1 is 6 degrees.
LEAN_SPREAD = 0.1
#: Least standard deviation of the turn about the camera's axis [deg].
TURN_DEG = 20.0
#: Least range of depths, as a share of the working distance.
DEPTH_SHARE = 0.1
#: A view whose rms exceeds the median of its device by this factor, a device with this share of outliers.
BAD_VIEW, OUTLIER_SHARE = 2.0, 0.02
#: Views that two devices share, below which their relative place rests on few.
SHARED_VIEWS = 6
#: Rms of left-out views over that of the adjusted ones: the model follows the views instead of the lens.
LEFT_OUT_FACTOR = 1.6
#: Residuals that stay the same over the views: significant, and large enough to matter against noise.
SYSTEMATIC_SIGMAS, SYSTEMATIC_SHARE = 5.0, 0.3
#: A region whose expected error exceeds that of the centre by this factor.
WEAK_REGION = 3.0


def device_title(device: str) -> str:
    """Return "camera A", "projector"."""
    return device if device == PROJECTOR else f"camera {device}"


def advice(calibration: Calibration, errors: Sequence[ExpectedError] | None = None) -> tuple[str, ...]:
    """Return what to do next time, the most useful first; nothing where nothing is amiss.

    Parameters
    ----------
    calibration : Calibration
        What is judged.
    errors : sequence of ExpectedError or None
        Those of `expected_errors`, where the caller has them already.
    """
    places = placements(calibration)
    maps = [coverage(calibration, device) for device in calibration.rig.devices]
    found = [
        *_number(calibration),
        *_shared(calibration),
        *(s for item in maps for s in empty_regions(item)),
        *tilt_advice(places),
        *_depth(calibration),
        *_bad_views(calibration),
        *_outliers(calibration),
        *_misfit(calibration, maps),
        *(
            s
            for e in (expected_errors(calibration) if errors is None else errors)
            for s in error_advice(e, calibration.scale[1])
        ),
    ]
    return tuple(found)


def _number(calibration: Calibration) -> list[str]:
    views = len(calibration.T_A_board)
    if views >= FEW_VIEWS:
        return []
    return [
        f"More views: {views} were used; {ENOUGH_VIEWS} with the board at different places, tilts and turns show a bad "
        f"one, and bring the error that noise leaves down to {100 * np.sqrt(views / ENOUGH_VIEWS):.0f} %."
    ]


def _shared(calibration: Calibration) -> list[str]:
    seen: dict[str, set[str]] = {device: set() for device in calibration.rig.devices}
    for r in calibration.residuals:
        if (~r.outlier).any():
            seen[r.device].add(r.view)
    out = []
    for device in calibration.rig.devices:
        shared = max((len(seen[device] & seen[other]) for other in seen if other != device), default=SHARED_VIEWS)
        if shared < SHARED_VIEWS:
            what = "view is" if shared == 1 else "views are"
            out.append(
                f"Only {shared} {what} shared by {device_title(device)} and another device: the place of the two to "
                "each other rests on them. Put the board where both see it."
            )
    return out


def empty_regions(item: Coverage) -> list[str]:
    """Return which regions of a device's image hold no or hardly any points, one sentence for each of the two."""
    shares = item.region_shares()
    empty = [name for name, share in shares.items() if share == 0]
    thin = [name for name, share in shares.items() if 0 < share < REGION_SHARE]
    where = f"of {device_title(item.device) if item.device != PROJECTOR else 'the projector'}"
    out = []
    if empty:
        out.append(f"No board in the {_listed(empty)} {where}: its distortion there is extrapolated. Put boards there.")
    if thin:
        out.append(f"Hardly any board in the {_listed(thin)} {where}: let the board reach the edges of the image.")
    return out


def tilt_advice(places: Sequence[Placement]) -> list[str]:
    """Return what the tilts and turns of the boards lack."""
    tilt = np.degrees([p.tilt_rad for p in places])
    if tilt.max() < TILT_DEG:
        return [
            f"Tilt more: all boards are within {tilt.max():.0f}° of the image plane. Tilts of 30° to 45° to all sides "
            "tell the focal length from the distance."
        ]
    out = []
    lean = np.array([p.lean for p in places])
    values, vectors = np.linalg.eigh(lean.T @ lean / len(lean))
    if np.sqrt(values[0]) < LEAN_SPREAD:
        sideways = abs(vectors[0, 1]) > abs(vectors[1, 1])
        have, lack = ("left and right", "up and down") if sideways else ("up and down", "left and right")
        out.append(f"Tilt about the other axis, too: the boards lean {have} only, not {lack}.")
    # Directions of lines: 180 degrees are the same turn.
    turn = 2 * np.array([p.turn_rad for p in places])
    length = min(1.0, float(np.hypot(np.cos(turn).mean(), np.sin(turn).mean())))
    if length > 0 and np.degrees(np.sqrt(-2 * np.log(length)) / 2) < TURN_DEG:
        out.append(
            "Turn the board by 90° in its plane for some views: as it is, an error of the board's own shape looks like "
            "one of the lens."
        )
    return out


def _depth(calibration: Calibration) -> list[str]:
    near, middle, far = depths_mm(calibration)
    if far - near >= DEPTH_SHARE * middle:
        return []
    return [
        f"Depth covered: {near:.0f} to {far:.0f} mm, {100 * (far - near) / middle:.0f} % of the distance. Put boards "
        "at the front and at the back of the measuring volume."
    ]


def bad_views(calibration: Calibration, device: str) -> dict[str, float]:
    """Return per view whose rms exceeds the median of its device by BAD_VIEW how many times it does, worst first."""
    rms = {r.view: r.rms_px for r in calibration.residuals if r.device == device and np.isfinite(r.rms_px)}
    if len(rms) < 3:
        return {}
    median = float(np.median(list(rms.values())))
    factors = {view: value / median for view, value in rms.items() if median > 0 and value > BAD_VIEW * median}
    return dict(sorted(factors.items(), key=lambda item: -item[1]))


def _bad_views(calibration: Calibration) -> list[str]:
    images = {view.name: view.images for view in calibration.observations.views}
    bad: dict[str, dict[str, float]] = {}
    for device in calibration.rig.devices:
        for view, factor in bad_views(calibration, device).items():
            bad.setdefault(view, {})[device] = factor
    out = []
    for view, factors in sorted(bad.items(), key=lambda item: -max(item[1].values())):
        files = [images.get(view, {}).get(device, view) for device in factors]
        named = sorted({name for name in files if PurePath(name).stem != view})
        where = [f"{factor:.1f} times in {device_title(device)}" for device, factor in factors.items()]
        of = f" ({', '.join(named)})" if named else ""
        out.append(
            f"Take {view}{of} again, or leave it out: its residuals are "
            f"{_listed(where)} those of the median view. Did the board or the sensor move?"
        )
    return out


def _outliers(calibration: Calibration) -> list[str]:
    out = []
    for device in calibration.rig.devices:
        own = [r for r in calibration.residuals if r.device == device]
        total, left = sum(len(r.outlier) for r in own), sum(int(r.outlier.sum()) for r in own)
        if total and left > OUTLIER_SHARE * total:
            worst = max(own, key=lambda r: int(r.outlier.sum()))
            out.append(
                f"{left} of {total} points of {device_title(device)} are outliers, {int(worst.outlier.sum())} of them "
                f"in {worst.view}: look there for blur, glare or something in front of the board."
            )
    return out


def _misfit(calibration: Calibration, maps: Sequence[Coverage]) -> list[str]:
    out = []
    for item in maps:
        rms, noise = calibration.rms_px(item.device), calibration.noise_px[item.device]
        left_out = calibration.left_out_rms_px.get(item.device, float("nan"))
        title = device_title(item.device)
        if left_out > LEFT_OUT_FACTOR * rms:
            out.append(
                f"Views left out of the adjustment are missed by {left_out:.3f} px in {title}, those in it by "
                f"{rms:.3f} px: the views are too few or too alike for the model. Take more, or a simpler model."
            )
        if item.significance > SYSTEMATIC_SIGMAS and item.systematic_px > SYSTEMATIC_SHARE * np.sqrt(2) * noise:
            flatness = "" if calibration.height_mm is not None else "; --flatness lets the board's shape vary"
            out.append(
                f"In parts of the image of {title} the residuals point the same way in all views "
                f"({item.systematic_px:.3f} px rms beyond noise): lens or board differ from their models. Compare the "
                f"lens models that were tried and measure the board{flatness}."
            )
    return out


def error_advice(error: ExpectedError, pitch_sigma: float) -> list[str]:
    """Return where the expected error is largest, and whether the pitch's standard deviation makes most of it."""
    out = []
    whole, scale = map_rms(error.form_mm), map_rms(error.scale_mm)
    pair = f"{device_title(error.own)} with {device_title(error.other)}"
    # Without the factor on all lengths, which no board at any place reduces.
    rows = np.array_split(np.arange(error.form_mm.shape[0]), 3)
    columns = np.array_split(np.arange(error.form_mm.shape[1]), 3)
    shares = {
        name: map_rms(error.warp_mm[np.ix_(rows[i], columns[j])])
        for i, row in enumerate(REGIONS)
        for j, name in enumerate(row)
    }
    middle = shares["centre"]
    # Where the scale makes nearly all of the error, boards at other places change nothing.
    weak = [name for name, value in shares.items() if value > max(WEAK_REGION * middle, whole / 2)]
    if weak and np.isfinite(middle):
        worst = max(shares[name] for name in weak)
        out.append(
            f"Measured by {pair}, the expected error in the {_listed(weak)} is up to {worst / middle:.1f} times that "
            "of the centre: boards there help most."
        )
    if scale**2 > 0.5 * whole**2 and pitch_sigma**2 > 0.5 * error.scale_sigma**2:
        out.append(
            f"{100 * scale / whole:.0f} % of the expected error of form of {pair} comes from the pitch: only a "
            "length of the board that is known better (known_length) makes it less."
        )
    return out


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
