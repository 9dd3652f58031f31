"""The least error that any refinement of a simulated pair can have: the Cramer-Rao bound from the scene itself.

Texture, light, noise and shape are the simulation's own; of what planish says about them nothing is used but which
pixels hold a point.

Two captures see one unknown texture c and one unknown surface. What both are to be compared by is unknown too, and
eliminating it (Schur complement) leaves the difference of both captures with the noise of both: the bound for two noisy
images of one unknown scene (Yetik and Nehorai, Performance bounds on image registration, IEEE Trans. Signal Processing
54(5), 2006; Aguerrebere, Delbracio, Bartesaghi, Sapiro, Fundamental limits in multi-image alignment, IEEE Trans. Signal
Processing 64(21), 2016). A change xi of T_a_b moves the surface at x by G xi, so that the information is

    F = integral dA [ (G'n)(G'n)' / (M_a + M_b) + s s' / (N_a + N_b + P) ],   s = G' grad c, without what is slow in it,

    N [mm^2]  noise of the texture per area: of one pixel's contrast (all images of both cameras by their noise, and the
              pixel response), times the area that the pixel covers;
    M [mm^4]  noise of the surface along its normal n per area: what the projector's position, known from the fringes by
              their noise, says in both cameras;
    P [mm^2]  both surfaces' noise, which moves where the rays of a and of b meet the texture: (t grad c)^2 M_a M_b /
              (M_a + M_b), t the difference of the rays' slopes against the normal;
    grad c    of a texture that is unknown at every point. To estimate it costs information where it is weaker than its
              noise: of spectrum S, S^2 / (N (2 S + N)) is left of S / (2 N) (unconditional instead of conditional
              bound: Stoica and Nehorai, IEEE Trans. ASSP 38(10), 1990; for shifts: Knapp and Carter, IEEE Trans. ASSP
              24(4), 1976, whose filter reaches it). Each frequency of grad c is weighed by the root of the ratio;
    slow      a gain, offset and shading between the textures are unknown: what a smooth field of SHADING_MM could
              explain of s tells nothing about xi.

The bound holds for unbiased estimates of a band-limited texture of known spectrum; neighbours' noise is independent in
the images. What is coarser than the bound knows nothing of: highlights, texture that passes for fringes, aliasing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from planish.geometry import Array, invert, transform_points
from refined_pairs.true_view import Map, Mask, TrueView

#: Standard deviation [mm] of the smooth field that shading may be: planish's own low-pass.
SHADING_MM = 2.5
#: Surfaces farther apart than this are not the same [mm].
APART_MM = 1.0


@dataclass(frozen=True)
class Bound:
    """Information F (6, 6) about xi = [rotation, translation mm] at a point of frame a, and its inverse."""

    information: Array
    covariance: Array


def errors_mm(covariance: Array, points_a: Array, normals_a: Array, about: Array) -> tuple[float, float]:
    """Return the expected error along the surface and along its normal over points (N, 3), root mean square [mm].

    `covariance` (6, 6) is that of xi = [rotation, translation mm] at the point `about`.
    """
    G = rigid(points_a - about)
    along_normal = np.einsum("ni,nik->nk", normals_a, G)
    total = np.einsum("nik,kl,nil->n", G, covariance, G).mean()
    normal = np.einsum("nk,kl,nl->n", along_normal, covariance, along_normal).mean()
    return float(np.sqrt(total - normal)), float(np.sqrt(normal))


def pair_bound(a: TrueView, b: TrueView, T_a_b: Array, about: Array) -> Bound:
    """Return the bound of a pair: the mean of what either grid says, which differ by how finely each is sampled."""
    F = 0.5 * (_information(a, b, T_a_b, np.eye(4), about) + _information(b, a, invert(T_a_b), T_a_b, about))
    return Bound(F, np.linalg.inv(F))


def rigid(lever: Array) -> Array:
    """Return G (N, 3, 6): displacements of points by xi."""
    G = np.zeros((len(lever), 3, 6))
    G[:, :, 3:] = np.eye(3)
    for axis in range(3):
        G[:, :, axis] = np.cross(np.eye(3)[axis], lever)
    return G


def _information(first: TrueView, second: TrueView, T_first_second: Array, T_a_first: Array, about: Array) -> Array:
    """Return F over the pixels of `first` that `second` sees too."""
    T = invert(T_first_second)
    pixels = second.camera.project(transform_points(T, first.points)).astype(np.float32)

    def there(values: Array) -> Array:
        found = [cv2.remap(v.astype(np.float32), pixels, None, cv2.INTER_LINEAR, borderValue=(np.nan,))
                 for v in np.moveaxis(np.atleast_3d(values), 2, 0)]  # fmt: skip
        return np.stack(found, -1).astype(float)

    N, M = (there(v)[..., 0] for v in (second.texture_noise, second.surface_noise))
    apart = np.linalg.norm(there(second.points) - transform_points(T, first.points), axis=2)
    slope = first.slope - there(second.slope) @ T[:3, :3]
    use = first.known & (there(second.known)[..., 0] > 0.99) & (apart < APART_MM) & np.isfinite(N + M + slope.sum(-1))
    moved = np.einsum("hwi,hwi->hw", first.gradient, slope) ** 2
    Ma = first.surface_noise
    with np.errstate(divide="ignore", invalid="ignore"):
        texture = np.where(use, first.area / (first.texture_noise + N + moved * Ma * M / (Ma + M)), 0.0)
    surface = first.area[use] / (Ma + M)[use]
    R = T_a_first[:3, :3].T
    G = np.zeros((*first.area.shape, 3, 6))
    G[use] = R @ rigid(transform_points(T_a_first, first.points[use]) - about)
    by_normal = np.einsum("ni,nik->nk", first.normals[use], G[use])
    s = np.einsum("hwi,hwik->hwk", np.where(use[..., None], first.gradient, 0.0), G)
    s = _without_slow(s, texture, use, SHADING_MM / float(np.sqrt(np.median(first.area[use]))))
    F = (by_normal.T * surface) @ by_normal + (s.T * texture[use]) @ s
    return np.asarray(F, float)


def _without_slow(s: Array, weight: Map, use: Mask, sigma_px: float) -> Array:
    """Return s (N, 6) at the pixels in use without the smooth field that fits it best around each."""
    blur = lambda image: cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_CONSTANT)  # noqa: E731
    below = np.maximum(blur(weight), 1e-300)
    return np.stack([(layer - blur(weight * layer) / below)[use] for layer in np.moveaxis(s, 2, 0)], -1)
