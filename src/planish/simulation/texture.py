"""Texture in millimetres on the surface: brushed grain, scratches, specks, smudges; everything follows from the seed.

Contrasts are relative changes of the reflectance on the surface, before lens and pixel average them: of the grain the
rms, of a mark the value at its middle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from planish import _core
from planish.geometry import Array
from planish.simulation.surfaces import Surface

#: Scales of the grain: factor on both lengths, share of the rms. Brushing leaves fine lines and broad streaks.
GRAIN_SCALES = ((1.0, 1.0), (2.1, 0.7), (4.7, 0.5), (11.0, 0.35))
#: Lattice spacing of smooth noise per correlation length (distance at which the correlation is 1/e).
SPACING_PER_CORRELATION = 0.85
#: Grain whose lattice is finer than this share of the distance between samples would alias instead of averaging out.
FINEST_LATTICE = 0.6
#: The brush strokes of the scales differ in direction by this standard deviation [rad].
STROKE_SPREAD = 0.02
_KINDS = {"scratch": 0, "speck": 1, "smudge": 2}


@dataclass(frozen=True)
class Grain:
    """Brushed grain: rms `contrast`, correlation lengths of its finest scale along and across the brush [mm]."""

    contrast: float = 0.02
    along_mm: float = 2.5
    across_mm: float = 0.25
    angle_rad: float = 0.0


@dataclass(frozen=True)
class Marks:
    """Randomly placed marks.

    Parameters
    ----------
    density_per_dm2 : float
        Mean number per square decimetre.
    contrast : float
        Typical contrast at the middle; single marks vary around it.
    length_mm, width_mm : tuple of float
        Range of the sizes (log-uniform): of scratches full length and standard deviation across, else half axes.
    bright : float
        Share of the marks that are brighter than their surroundings.
    """

    density_per_dm2: float
    contrast: float
    length_mm: tuple[float, float]
    width_mm: tuple[float, float]
    bright: float = 0.0


@dataclass(frozen=True)
class Texture:
    """All layers of the reflectance; None = the layer is absent."""

    albedo: float = 0.55
    grain: Grain | None = Grain()
    scratches: Marks | None = Marks(1.0, 0.12, (8.0, 70.0), (0.07, 0.16), bright=0.7)
    specks: Marks | None = Marks(6.0, 0.25, (0.15, 0.7), (0.15, 0.7), bright=0.2)
    smudges: Marks | None = Marks(0.25, 0.05, (8.0, 35.0), (5.0, 18.0), bright=0.25)

    def with_grain(self, contrast: float) -> Texture:
        """Return the texture with another rms contrast of the grain (0 = none)."""
        return replace(self, grain=replace(self.grain or Grain(), contrast=contrast) if contrast > 0 else None)

    def with_density(self, factor: float) -> Texture:
        """Return the texture with the density of all marks multiplied (0 = none)."""

        def thin(marks: Marks | None) -> Marks | None:
            if marks is None or factor <= 0:
                return None
            return replace(marks, density_per_dm2=marks.density_per_dm2 * factor)

        return replace(
            self, scratches=thin(self.scratches), specks=thin(self.specks), smudges=thin(self.smudges)
        )  # fmt: skip


#: A surface without any texture.
BLANK = Texture(grain=None, scratches=None, specks=None, smudges=None)


def kernel_texture(
    texture: Texture, half_s: float, half_t: float, seed: int, sample_mm: float = 0.0
) -> dict[str, Any]:  # fmt: skip
    """Return the texture of a surface |s| <= half_s, |t| <= half_t [mm] for the core.

    Grain too fine for samples `sample_mm` apart is left out: a pixel averages it away.
    """
    rng = np.random.Generator(np.random.Philox(key=[seed, 1]))
    layers = [
        _place_marks(kind, marks, half_s, half_t, rng)
        for kind, marks in (
            ("smudge", texture.smudges),
            ("speck", texture.specks),
            ("scratch", texture.scratches),
        )
    ]
    return {
        "albedo": float(texture.albedo),
        "grain": _grain_scales(texture.grain, seed, sample_mm),
        "marks": np.ascontiguousarray(np.concatenate(layers)),
        "half_s": float(half_s),
        "half_t": float(half_t),
    }


def reflectance(texture: Texture, surface: Surface, st: Array, seed: int) -> Array:
    """Return the reflectance (N,) at surface coordinates (N, 2) [mm]."""
    out = np.empty(len(st))
    values = kernel_texture(texture, surface.half_s, surface.half_t, seed)
    _core.texture_albedo(values, np.ascontiguousarray(st, float), out)
    return out


def _grain_scales(grain: Grain | None, seed: int, sample_mm: float) -> Array:
    """Return rows (n, 5): lattice spacing along, across [mm], angle [rad], rms amplitude, seed."""
    if grain is None:
        return np.empty((0, 5))
    rng = np.random.Generator(np.random.Philox(key=[seed, 2]))
    factors, shares = np.array(GRAIN_SCALES).T
    amplitudes = grain.contrast * shares / np.linalg.norm(shares)
    n = len(factors)
    angles = grain.angle_rad + STROKE_SPREAD * rng.standard_normal(n)
    seeds = rng.integers(0, 2**32, n).astype(float)
    along, across = (SPACING_PER_CORRELATION * length * factors for length in (grain.along_mm, grain.across_mm))
    scales = np.column_stack([along, across, angles, amplitudes, seeds])
    return np.ascontiguousarray(scales[across >= FINEST_LATTICE * sample_mm])


def _place_marks(kind: str, marks: Marks | None, half_s: float, half_t: float, rng: np.random.Generator) -> Array:
    """Return rows (n, 8): kind, s, t [mm], angle [rad], half length, half width [mm], curvature [1/mm], contrast."""
    if marks is None:
        return np.empty((0, 8))
    n = int(rng.poisson(marks.density_per_dm2 * 4 * half_s * half_t / 1e4))

    def sizes(span: tuple[float, float]) -> Array:
        return np.exp(rng.uniform(np.log(span[0]), np.log(span[1]), n))

    s, t = rng.uniform(-half_s, half_s, n), rng.uniform(-half_t, half_t, n)
    angle, length, width = rng.uniform(0, 2 * np.pi, n), sizes(marks.length_mm), sizes(marks.width_mm)
    strength = marks.contrast * np.exp(0.5 * rng.standard_normal(n))
    sign = np.where(rng.uniform(size=n) < marks.bright, 1.0, -1.0)
    curvature = np.zeros(n)
    if kind == "scratch":
        length = length / 2
        curvature = 0.08 * rng.standard_normal(n) / length
    contrast = np.where(sign > 0, strength, -np.minimum(strength, 0.9))
    return np.column_stack([np.full(n, _KINDS[kind]), s, t, angle, length, width, curvature, contrast])
