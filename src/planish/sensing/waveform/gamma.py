"""Fringes that are no cosine: the phase error they make, found from the phases themselves, and taken away.

A response that is not linear (gamma of projector or camera) adds harmonics to the fringes; N steps turn those of
order N - 1 and N + 1, 2N - 1, ... into an error of the phase with N, 2N, ... cycles per period. It is the same function
of the phase in every camera, so that between two cameras it cancels but for what interpolation in the other camera
smoothes; between camera and projector it does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from planish.sensing.decode import PhaseMap

Array = NDArray[np.float64]

#: Harmonics N, 2N, ... that are looked at reach so many cycles per period, and are so many at most.
MAX_CYCLES, MAX_HARMONICS = 24, 8
#: The highest harmonic that is kept is so many standard deviations large.
KEEP_SIGMAS = 4.0
#: Image lines that are looked at, and clusters of pixels along and across them whose scatter gives the covariance.
LINES, CLUSTERS = 64, 8
#: Lines on which it is found out whether there is an error at all.
FIRST_LINES = 8
#: Second differences beyond so many robust standard deviations are edges.
CLIP_SIGMAS = 4.0
#: chi^2 per degree of freedom from which an error is one, and amplitude below which it matters nowhere [rad].
MIN_CHI2, MIN_AMPLITUDE_RAD = 6.0, 5e-4
#: Beyond this condition number some harmonic cannot be seen.
MAX_CONDITION = 1e12
#: Equations per unknown below which nothing is said.
MIN_EQUATIONS = 500


@dataclass(frozen=True)
class WaveError:
    """The correction g of a phase: phi_true = phi + g(phi), g = sum_k s_k sin(k N phi) + c_k cos(k N phi).

    Parameters
    ----------
    steps : int
        N.
    coefficients : ndarray (K, 2)
        s_k, c_k [rad].
    covariance : ndarray (2 K, 2 K)
        Theirs, row by row [rad^2].
    variation_rad : float
        Standard deviation of s_1, c_1 between the parts of the image, beyond their noise.
    noise_ratio : float
        Scatter of the phases from pixel to pixel over what their sigma states, 1 at most: the scatter holds noise and
        more, so that less than 1 means that sigma is too large (the noise model is linear in the grey level).
    """

    steps: int
    coefficients: Array
    covariance: Array
    variation_rad: float
    noise_ratio: float = 1.0

    @property
    def amplitude_rad(self) -> float:
        """Amplitude of the first harmonic."""
        return float(np.hypot(*self.coefficients[0]))

    @property
    def amplitude_sigma_rad(self) -> float:
        """Standard deviation of the amplitude."""
        direction = self.coefficients[0] / max(self.amplitude_rad, 1e-30)
        return float(np.sqrt(direction @ self.covariance[:2, :2] @ direction))

    @property
    def significant(self) -> bool:
        """Whether there is an error, and one that matters."""
        flat = self.coefficients.ravel()
        chi2 = float(flat @ np.linalg.solve(self.covariance, flat))
        return chi2 > MIN_CHI2 * len(flat) and self.amplitude_rad > MIN_AMPLITUDE_RAD

    @property
    def remaining_sigma_rad(self) -> float:
        """Standard deviation of the phase by what of the correction is uncertain."""
        return float(np.sqrt(0.5 * np.trace(self.covariance) + self.variation_rad**2))

    def correction(self, phase: NDArray[np.floating]) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
        """Return g(phi) (...,) [rad] of phases (...,) [rad], and its derivative."""
        total, slope = np.zeros_like(phase), np.zeros_like(phase)
        for k, (s, c) in enumerate(self.coefficients.astype(phase.dtype), start=1):
            cycles = k * self.steps
            sine, cosine = np.sin(cycles * phase), np.cos(cycles * phase)
            total += s * sine + c * cosine
            slope += cycles * (s * cosine - c * sine)
        return total, slope


def estimate_wave_error(phase: PhaseMap, period_px: float, steps: int, lines: int = LINES) -> WaveError | None:
    """Return the error of a camera's phases that repeats with their period; None where too few are known.

    Parameters
    ----------
    phase : PhaseMap
        Positions (H, W) by the finest period; whole periods do not matter.
    period_px : float
        That period [projector px].
    steps : int
        Its phase steps N.
    lines : int
        Image lines that are looked at.

    Notes
    -----
    On a smooth surface the true phase is nearly linear over a few pixels, and its second difference D over a distance h
    is small and knows nothing of the phase. So D phi = -D g(phi), which is linear in the coefficients of g and exact in
    the measured phase: least squares over several h, for each harmonic has its blind ones. The covariance is that of
    clusters (sandwich; Liang and Zeger 1986): neighbouring equations share pixels and surface.
    """
    angle, sigma = _lines(phase, period_px, lines)
    few = max(1, len(angle) // FIRST_LINES)
    first = _fit(angle[::few], sigma[::few], steps, 1)
    if first is None or not first.significant:
        return first
    error = _fit(angle, sigma, steps, int(np.clip(MAX_CYCLES // steps, 1, MAX_HARMONICS)))
    return error and replace(error, noise_ratio=_noise_ratio(angle, sigma, error))


def _fit(angle: Array, sigma: Array, steps: int, count: int) -> WaveError | None:
    waves = np.stack([f(k * steps * angle) for k in range(1, count + 1) for f in (np.sin, np.cos)])
    clusters = CLUSTERS * CLUSTERS
    normal, right = np.zeros((clusters, 2 * count, 2 * count)), np.zeros((clusters, 2 * count))
    equations = 0
    for lag in _lags(angle, steps):
        more = _equations(angle, sigma, waves, lag)
        normal, right, equations = normal + more[0], right + more[1], equations + more[2]
    if equations < MIN_EQUATIONS * 2 * count:
        return None
    if not np.linalg.cond(normal.sum(0)) < MAX_CONDITION:
        return None
    error = _solve(normal, right, steps)
    deviations = np.abs(error.coefficients.ravel()) / np.sqrt(np.diag(error.covariance))
    kept = int(np.max(np.flatnonzero(deviations > KEEP_SIGMAS), initial=0)) // 2 + 1
    return _solve(normal[:, : 2 * kept, : 2 * kept], right[:, : 2 * kept], steps)


def _solve(normal: Array, right: Array, steps: int) -> WaveError:
    total, clusters = normal.sum(0), len(normal)
    flat = np.linalg.solve(total, right.sum(0))
    scores, inverse = right - normal @ flat, np.linalg.inv(total)
    covariance = inverse @ (scores.T @ scores) @ inverse * clusters / (clusters - 1)
    return WaveError(steps, flat.reshape(-1, 2), covariance, _variation(normal, right, flat, covariance))


def without_wave_error(phase: PhaseMap, error: WaveError, period_px: float) -> PhaseMap:
    """Return the positions without the error; sigma follows its slope, and what is uncertain about it is added."""
    scale = np.float32(period_px / (2 * np.pi))
    angle = np.mod(phase.position_px / np.float32(period_px), np.float32(1)) * np.float32(2 * np.pi)
    correction, slope = error.correction(angle)
    position = phase.position_px + scale * correction
    noise = phase.sigma_px * np.float32(error.noise_ratio) * np.abs(1 + slope)
    sigma = np.hypot(noise, scale * np.float32(error.remaining_sigma_rad))
    return replace(phase, position_px=position, sigma_px=sigma)


def _lines(phase: PhaseMap, period_px: float, lines: int) -> tuple[Array, Array]:
    """Phases and their sigma (lines, n) [rad] of a sample of the image lines that cross the fringes."""
    position, sigma, scale = phase.position_px, phase.sigma_px, 2 * np.pi / period_px
    if _slope(scale * position[:, :: max(1, position.shape[1] // lines)].T) > _slope(
        scale * position[:: max(1, position.shape[0] // lines)]
    ):
        position, sigma = position.T, sigma.T
    step = max(1, position.shape[0] // lines)
    return scale * position[::step].astype(float), scale * sigma[::step].astype(float)


def _wrapped(angle: NDArray[np.floating]) -> NDArray[np.floating]:
    return np.asarray(angle - 2 * np.pi * np.round(angle / (2 * np.pi)))


def _slope(phase: NDArray[np.floating]) -> float:
    steps = np.abs(_wrapped(np.diff(phase, axis=1)))
    known = steps[np.isfinite(steps)]
    return float(np.median(known)) if known.size else 0.0


def _lags(phase: Array, steps: int) -> list[int]:
    """Distances [px] of second differences: fractions of the error's wave length, or the shortest three there are."""
    slope = _slope(phase)
    if not slope > 0:
        return []
    length, longest = 2 * np.pi / (steps * slope), max(3, phase.shape[1] // (4 * CLUSTERS))
    lags: list[int] = []
    for share in (1 / 5, 1 / 3, 1 / 2):
        lags.append(min(max(round(length * share), 1, lags[-1] + 1 if lags else 1), longest))
    return sorted(set(lags))


def _second_difference(values: Array, lag: int) -> Array:
    return np.asarray(values[..., 2 * lag :] - 2 * values[..., lag:-lag] + values[..., : -2 * lag])


def _equations(phase: Array, sigma: Array, waves: Array, lag: int) -> tuple[Array, Array, int]:
    """Normal equations (clusters, 2 K, 2 K) and (clusters, 2 K) of one distance, and their number."""
    bend = _wrapped(_second_difference(phase, lag))
    known = np.isfinite(bend)
    unknowns, clusters = len(waves), CLUSTERS * CLUSTERS
    normal, right = np.zeros((clusters, unknowns, unknowns)), np.zeros((clusters, unknowns))
    if not known.any():
        return normal, right, 0
    limit = CLIP_SIGMAS * 1.4826 * np.median(np.abs(bend[known]))
    line, column = np.nonzero(np.abs(np.where(known, bend, np.inf)) < limit)
    X, y = _second_difference(waves, lag)[:, line, column], -bend[line, column]
    weighted = X / sigma[line, column + lag] ** 2
    # Lines come in order: the pixels of a row of clusters stand together.
    cluster = (line * CLUSTERS // phase.shape[0]) * CLUSTERS + column * CLUSTERS // bend.shape[1]
    for i in range(clusters):
        members = np.flatnonzero(cluster == i)
        normal[i] = weighted[:, members] @ X[:, members].T
        right[i] = weighted[:, members] @ y[members]
    return normal, right, len(y)


def _noise_ratio(angle: Array, sigma: Array, error: WaveError) -> float:
    correction, slope = error.correction(angle)
    bend = _second_difference(angle + np.asarray(correction, float), 1)
    variance = (sigma * (1 + slope)) ** 2
    expected = np.sqrt(variance[:, 2:] + 4 * variance[:, 1:-1] + variance[:, :-2])
    scatter = np.abs(_wrapped(bend) / expected)
    return min(1.0, 1.4826 * float(np.nanmedian(scatter)))


def _variation(normal: Array, right: Array, flat: Array, covariance: Array) -> float:
    """Standard deviation (root mean square of s_1 and c_1) between clusters, beyond their noise."""
    share = normal[:, 0, 0] / normal[:, 0, 0].sum()
    # Where all measured phases are alike, a cluster says nothing about one of the two.
    use = (share > 0.2 / len(share)) & (np.linalg.cond(normal[:, :2, :2]) < MAX_CONDITION)
    if use.sum() < CLUSTERS:
        return 0.0
    rest = (right - normal @ flat)[use][:, :2]
    local = np.stack([np.linalg.solve(n[:2, :2], r) for n, r in zip(normal[use], rest, strict=True)])
    noise = np.median(0.5 * np.trace(covariance[:2, :2]) / share[use])
    return float(np.sqrt(max(0.5 * ((1.4826 * np.median(np.abs(local), axis=0)) ** 2).sum() - noise, 0.0)))
