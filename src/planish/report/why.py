"""Why each pixel has no point, as a colour image with its legend, and as shares.

A pixel may carry several reasons: what made it fail first made the rest happen. So it is shown and counted under its
decisive reason, the first of its reasons in the order of `REJECTIONS`, which is that of the stages.
"""

from __future__ import annotations

import io
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from planish.measurement import REJECTIONS, Map, Measurement, count_reasons
from planish.report.style import INK, rgb, save_bytes

#: One colour per reason. Found by maximising the least distance of any two, and from greys, in CIE Lab, for normal
#: vision and for protan-, deuter- and tritanopia: at least 24 everywhere (about ten times what can just be seen).
COLOURS: dict[str, str] = {
    "masked": "#60009f",
    "dark": "#0020ff",
    "saturated": "#bf8000",
    "slip": "#ff80ff",
    "interreflection": "#bfff80",
    "mixed": "#00ff00",
    "unmatched": "#9f2000",
    "mismatch": "#9f0080",
    "edge": "#209f60",
    "isolated": "#9f60ff",
    "ambiguous": "#4b000f",
}
#: Grey range of the texture, and the quantiles of its grey levels that are stretched to it.
GREYS, QUANTILES = (40, 225), (0.01, 0.99)
#: A pixel without a point, a reason or a texture.
NOTHING = 255
#: Letters are as high as this share of the picture's width, within limits [px]; columns of the legend.
LETTER_SHARE, LETTER_PX, COLUMNS = 1 / 62, (9, 40), 4

Picture = NDArray[np.uint8]


def decisive_reason(measurement: Measurement) -> NDArray[np.int8]:
    """Return per pixel (H, W) the index into REJECTIONS of its decisive reason, -1 where there is a point."""
    rejected = measurement.rejected
    out = np.full(rejected.shape, -1, np.int8)
    for index in reversed(range(len(REJECTIONS))):
        out[(rejected >> np.uint16(index)) & np.uint16(1) > 0] = index
    return out


def rejection_shares(measurement: Measurement) -> dict[str, float]:
    """Return the share of all pixels that hold a point ("valid"), and that of every decisive reason."""
    counts, pixels = count_reasons(measurement.rejected), measurement.rejected.size
    shares = {name: count / pixels for name, count in counts.items()}
    return {"valid": (pixels - sum(counts.values())) / pixels, **shares}


def why_picture(measurement: Measurement) -> Picture:
    """Return the picture (H + h, W, 3) uint8.

    The first H rows are the pixels of the organising camera: its texture in grey where there is a point, else the
    colour of the decisive reason. The legend stands in the h rows below, so that (u, v) are the camera's pixels.
    """
    reason = decisive_reason(measurement)
    grey = _texture(measurement)
    palette = np.array([np.rint(rgb(COLOURS[name]) * 255) for name in REJECTIONS], np.uint8)
    picture = np.where((reason < 0)[..., None], grey[..., None], palette[np.maximum(reason, 0)])
    legend = _legend(rejection_shares(measurement), picture.shape[1])
    return np.ascontiguousarray(np.concatenate([picture, legend]), np.uint8)


def write_why(path: Path, measurement: Measurement) -> None:
    """Write `why_picture` as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(why_picture(measurement)).save(buffer, format="png")
    save_bytes(path, buffer.getvalue())


def _texture(measurement: Measurement) -> Picture:
    view = measurement.views[measurement.organised_on]
    value: Map | None = next((m for m in (view.mean, view.white, view.modulation) if m is not None), None)
    if value is None or not np.isfinite(value).any():
        return np.full(measurement.shape, GREYS[1], np.uint8)
    known = np.isfinite(value)
    shown = known & measurement.valid
    low, high = np.quantile(value[shown if shown.any() else known], QUANTILES)
    level = ((value - low) / max(float(high - low), 1e-6)).clip(0, 1)
    return np.where(known, GREYS[0] + (GREYS[1] - GREYS[0]) * np.nan_to_num(level), NOTHING).astype(np.uint8)


def _legend(shares: dict[str, float], width: int) -> Picture:
    letter = int(np.clip(width * LETTER_SHARE, *LETTER_PX))
    columns = min(COLUMNS, max(1, width // (16 * letter)))
    rows = -(-len(shares) // columns)
    line = 2 * letter
    image = Image.new("RGB", (width, rows * line + letter), "white")
    draw = ImageDraw.Draw(image)
    # The font that comes with matplotlib: the same picture on every machine.
    font = ImageFont.truetype(str(Path(mpl.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), letter)
    for k, (name, share) in enumerate(shares.items()):
        left, top = (k // rows) * width // columns + letter, (k % rows) * line + letter // 2
        box = (left, top + letter // 4, left + 2 * letter, top + letter // 4 + int(1.2 * letter))
        if name == "valid":
            for x in range(box[0], box[2] + 1):
                tone = GREYS[0] + (GREYS[1] - GREYS[0]) * (x - box[0]) // (2 * letter)
                draw.line((x, box[1], x, box[3]), fill=(tone, tone, tone))
        else:
            draw.rectangle(box, fill=COLOURS[name])
        draw.text((box[2] + letter // 2, top + letter // 5), f"{name} {share_text(share)}", fill=INK, font=font)
    return np.asarray(image)


def share_text(share: float) -> str:
    """Return a share in %, none of it lost to rounding: 0 % means that there is none."""
    if 0 < share < 5e-5:
        return "< 0.01 %"
    return f"{100 * share:.2f} %" if share > 0 else "0 %"
