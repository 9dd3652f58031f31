"""Where a filter puts the texture of a bent surface: beside its place, by as much as the surface bends in the image.

A filter averages over pixels on all sides alike. On a surface that turns away, the pixels of one side cover more of the
surface than those of the other: what the filter shows at a pixel stands beside it. Two cameras that see a pipe from two
sides would be led astray by the sum of both.
"""

from __future__ import annotations

import cv2
import numpy as np

from planish.geometry import Array
from planish.measurement import Map

#: Frequencies that a filter passes by less than this share are not passed.
_EMPTY = 1e-3
#: Samples per standard deviation of what is averaged over frequencies.
_SAMPLES = 4
#: Edge of the squares of pixels over which the surface's tangents are averaged before they are compared [px].
_SQUARE_PX, _STRIDE = 8, 2
#: Squares of which less than this share is known say nothing.
_LEAST_KNOWN = 0.3
#: Derivative of the sixth order by pixels.
_DERIVATIVE = np.array([[-1, 9, -45, 0, 45, -9, 1]], np.float32) / 60


def filter_reach(response: Array, power: Array, size: tuple[int, int], reach_px: float) -> Array:
    """Return how far a filter reaches as a texture is displaced by it (2, 2, 2, 2) [px^2].

    Parameters
    ----------
    response : ndarray (h, w // 2 + 1)
        Of the filter to frequencies.
    power : ndarray (h, w // 2 + 1)
        Of the filtered texture.
    size : tuple of two int
        (h, w) of the transform.
    reach_px : float
        Only as far its weights count: what the response resolves beyond is the chance of one measurement's spectrum,
        which another one does not share.

    Returns
    -------
    ndarray (2, 2, 2, 2)
        E[k, l, i, j]: pixels of the image bend by kappa = d^2 s / (du_i du_j), s the place on the surface in pixels;
        the texture moves by E[k, l, i, j] kappa[l, i, j] / 2.

    Notes
    -----
    A wave of the frequency f, cos 2 pi f (u + kappa(u, u) / 2), is changed in phase by pi f kappa_ij M_ij / H, H its
    response and M_ij = -H_ij / (4 pi^2) the transform of the filter's weights times u_i u_j. The displacement that
    explains the phases of all frequencies best, in proportion to what each says about a shift, P f f', is E kappa / 2
    with E = (sum P f f')^-1 sum P f f' M_ij / H. Of two measurements that share the texture alone, one of the two H in
    P is that of the other: known as far as it is smooth.
    """
    spread = [n / (2 * np.pi * reach_px) for n in size]
    step = max(1, int(min(spread) / _SAMPLES))
    with np.errstate(divide="ignore", invalid="ignore"):
        once = np.where(response > _EMPTY * response.max(), power / response, 0.0)
    H, P = (_squares(_whole(x, size), step) for x in (response, once))
    H = cv2.GaussianBlur(H, (0, 0), spread[1] / step, sigmaY=spread[0] / step, borderType=cv2.BORDER_REFLECT)
    fy, fx = (((np.arange(m) + 0.5) * step - 0.5 - (n - 1) // 2) / n for m, n in zip(H.shape, size, strict=True))
    slopes = [np.gradient(H, fx, axis=1), np.gradient(H, fy, axis=0)]
    f = np.stack(np.meshgrid(fx, fy))
    moments = np.empty((2, 2, *H.shape))
    for i in range(2):
        moments[i, 0], moments[i, 1] = np.gradient(slopes[i], fx, axis=1), np.gradient(slopes[i], fy, axis=0)
    moments /= -4 * np.pi**2
    weighted = f * P
    said = np.einsum("kyx,lyx,yx->kl", weighted, f, H)
    moved = np.einsum("kyx,lyx,ijyx->klij", weighted, f, moments, optimize=True)
    return np.asarray(np.einsum("km,mlij->klij", np.linalg.pinv(said, hermitian=True), moved))


def displacement(tangents: Map, reach: Array) -> Map:
    """Return by how much a filter of this reach displaces the texture at each pixel (H, W, 2) [px].

    Parameters
    ----------
    tangents : ndarray (H, W, 6)
        Change of the surface's points along u and along v [mm per pixel].
    reach : ndarray (2, 2, 2, 2)
        Of the filter (`filter_reach`).

    Notes
    -----
    How the pixels bend on the surface, whatever its coordinates, are the Christoffel symbols of its metric g in pixels:
    kappa[l, i, j] = g^lm (d^2 x / du_i du_j) . (dx / du_m) (do Carmo, Differential Geometry of Curves and Surfaces,
    sec. 4-3).
    """
    height, width = tangents.shape[:2]
    # They are of fits over several pixels: every second one holds all that they say.
    tangents = tangents[::_STRIDE, ::_STRIDE]
    known = np.isfinite(tangents[..., 2])
    share = _smooth(known.astype(np.float32))
    if min(share.shape) < 2:
        return np.zeros((height, width, 2), np.float32)
    enough = np.where(share > _LEAST_KNOWN, share, np.float32(np.nan))[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        x_u, x_v = (
            np.asarray(_smooth(np.where(known[..., None], tangents[..., three], np.float32(0))) / enough, np.float32)
            for three in (slice(3), slice(3, 6))
        )
        (uv, uu), (vv, vu) = (_by_pixel(x) for x in (x_u, x_v))
        bent = uu, np.float32(0.5) * (uv + vu), vv
        along_u, along_v = (np.stack([_dot(t, b) for b in bent]) for t in (x_u, x_v))
        g_uu, g_uv, g_vv = _dot(x_u, x_u), _dot(x_u, x_v), _dot(x_v, x_v)
        symbols = np.stack([g_vv * along_u - g_uv * along_v, g_uu * along_v - g_uv * along_u])
        determinant = g_uu * g_vv - g_uv**2
        # Bent along u and v and along v and u is the same.
        once = np.stack([reach[..., 0, 0], reach[..., 0, 1] + reach[..., 1, 0], reach[..., 1, 1]], -1)
        moved = np.einsum("klp,lpyx->yxk", once.astype(np.float32) / 2, symbols) / determinant[..., None]
    moved[~(np.isfinite(moved).all(-1) & (determinant > 0))] = 0
    # The centre of a square of pixels is the middle of its own.
    return cv2.resize(moved, (width, height), interpolation=cv2.INTER_LINEAR)


def _by_pixel(x: Map) -> tuple[Map, Map]:
    """Derivatives of the means of squares (h, w, 3) along v and along u, per pixel."""
    by_v, by_u = (np.asarray(np.gradient(x, _SQUARE_PX, axis=axis), np.float32) for axis in (0, 1))
    return by_v, by_u


def _dot(a: Map, b: Map) -> Map:
    """Products (h, w) of vectors (h, w, 3)."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def moved_back(texture: Map, moved: Map) -> Map:
    """Return a texture (H, W) without a displacement (H, W, 2) of small parts of a pixel."""
    along_u, along_v = (
        cv2.filter2D(texture, -1, kernel, borderType=cv2.BORDER_REPLICATE) for kernel in (_DERIVATIVE, _DERIVATIVE.T)
    )
    return np.asarray(texture - moved[..., 0] * along_u - moved[..., 1] * along_v)


def _whole(half: Array, size: tuple[int, int]) -> Map:
    """Return the spectrum (h, w), lowest frequency first, of a half one of a real image (h, w // 2 + 1)."""
    opposite = np.roll(half[::-1], 1, axis=0)
    both = np.hstack([opposite[:, size[1] - half.shape[1] : 0 : -1], half])
    return np.ascontiguousarray(np.roll(both, (size[0] - 1) // 2, axis=0), np.float32)


def _squares(image: Map, step: int) -> Map:
    """Means over whole squares."""
    height, width = (n // step for n in image.shape)
    return cv2.resize(
        np.ascontiguousarray(image[: height * step, : width * step]), (width, height), interpolation=cv2.INTER_AREA
    )


def _smooth(image: Map) -> Map:
    """Means over squares of pixels, and their neighbours."""
    height, width = (-(-n * _STRIDE // _SQUARE_PX) for n in image.shape[:2])
    small = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), 1.0, borderType=cv2.BORDER_CONSTANT)
