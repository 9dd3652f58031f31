"""How far each relation is from what all others say: data snooping with the reliability theory of Baarda (1968)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from planish.geometry import Array
from planish.registration.network.relations import Linearised, Stack

#: Share of a relation's variance left to its residual below which only rounding is left of it. Rounding grows as the
#: condition of the equations, with the third power of the longest chain: measured 3e-14 of it for chains of 20 to 1000.
_UNCONTROLLED, _ROUNDING = 1e-8, 1e-13
#: The same of information, where what is not controlled has been set to zero.
_ZERO = 1e-12


@dataclass(frozen=True)
class Contradiction:
    """One relation against all others.

    Parameters
    ----------
    mm : float
        How far it puts its point from where the others put it [mm]; 0 where nothing else ties the two together.
    sigma : float
        The same in standard deviations of noise and calibration (root of the quadratic form over six).
    noise_sigma : float
        The same by noise alone, the weights of the adjustment: the relation to blame has the largest one.
    chance : float
        Probability of at least this contradiction by noise and calibration.
    redundancy : float
        Share of its information that others control: 0 where nothing would notice its error, 1 where it adds none.
    weakest_mm : float or None
        Shift of its point, in the direction that the others control least, that makes one standard deviation of
        `sigma` [mm]; None where a direction is not controlled.
    """

    mm: float
    sigma: float
    noise_sigma: float
    chance: float
    redundancy: float
    weakest_mm: float | None


def contradictions(stack: Stack, lin: Linearised, hat: Array, left: Array, depth: int) -> list[Contradiction]:
    """Return the contradiction of each relation.

    A certain relation pulls the network along, so that its residual r alone shows little of its error; the covariance
    of the whitened r, 1 - hat, undoes that. Directions that no other relation controls count nothing.

    Parameters
    ----------
    hat : ndarray (E, 6, 6)
        Whitened covariance of what the network says: J N^-1 J'.
    left : ndarray (E, 6, k)
        What each mode of the rigs leaves in r, whitened: it adds to what r may be.
    depth : int
        Relations on the way from the datum to the member farthest from it.
    """
    left_over = np.eye(6) - hat
    diagonal = np.arange(6)
    # The last rows of a relation that holds fewer than six directions say nothing: nothing controls them.
    left_over[:, diagonal, diagonal] *= diagonal < stack.dof[:, None]
    values, vectors = np.linalg.eigh(left_over)
    controlled = values > max(_UNCONTROLLED, _ROUNDING * depth**3)
    V = vectors * controlled[:, None, :]
    z = np.einsum("eij,ei->ej", V, lin.r)
    modes = np.swapaxes(V, 1, 2) @ left
    spread = modes @ np.swapaxes(modes, 1, 2)
    spread[:, diagonal, diagonal] += np.where(controlled, values, 1.0)
    weighted = z / np.where(controlled, values, 1.0)
    by_noise = np.sum(z * weighted, 1)
    quadratic = np.einsum("ei,ei->e", z, np.linalg.solve(spread, z[:, :, None])[:, :, 0])
    gap = (np.linalg.pinv(stack.root) @ np.einsum("eij,ej->ei", V, weighted)[:, :, None])[:, :, 0]
    count = controlled.sum(1)
    chance = np.where(count > 0, chdtrc(np.maximum(count, 1), np.maximum(quadratic, 0)), 1.0)
    redundancy = np.sum(np.where(controlled, values, 0), 1) / np.maximum(stack.dof, 1)
    weakest = _weakest(stack.root[:, :, 3:], V * np.where(controlled, values, 0)[:, None, :], spread)
    return [
        Contradiction(
            float(np.linalg.norm(gap[e, 3:])), float(np.sqrt(max(0.0, quadratic[e]) / 6)),
            float(np.sqrt(max(0.0, by_noise[e]) / 6)), float(chance[e]), float(redundancy[e]), weakest[e],
        )
        for e in range(len(stack.relations))
    ]  # fmt: skip


def _weakest(root: Array, seen: Array, spread: Array) -> list[float | None]:
    """Shift that makes one sigma in the worst direction: a true error g shows as z = seen' root g."""
    z = np.swapaxes(seen, 1, 2) @ root
    information = np.swapaxes(z, 1, 2) @ np.linalg.solve(spread, z)
    own = np.swapaxes(root, 1, 2) @ root
    least, most = np.linalg.eigvalsh(information)[:, 0], np.linalg.eigvalsh(own)[:, -1]
    return [float(np.sqrt(6 / a)) if a > _ZERO * b > 0 else None for a, b in zip(least, most, strict=True)]
