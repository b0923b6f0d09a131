"""Compute the texture of a heightfield: a fractional Laplacian, which is positive on ridges and negative in valleys of all sizes.

The filter multiplies a heightfield's spectrum by the frequency to the power ``EXPONENT`` (L. Brown 2010, *Texture shading: a new
technique for depicting terrain relief*). Ridges and valleys of all sizes show at once, whatever side the light comes from.

The filter here is its kernel, tapered to 0 at ``RADIUS_NODES``. So a node's texture depends on its surroundings alone, and
blocks of a map meet without a seam. The taper cuts off landforms that are several times as wide as the radius.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached

EXPONENT = 0.8
"""Exponent of the frequency: 0 returns the heights, 2 their curvature. Lower exponents show larger landforms.

At 0.8 the texture over the spacing of nodes has about the same size on natural relief at all scales: its root mean square is 0.05
to 0.15 for cells of 1 to 1,000 m (11 rasters of mountains, hills and coasts), and 0.008 on a plain.
"""

RADIUS_NODES = 64
"""Radius of the filter's kernel, in nodes."""

_KERNEL_PERIOD_NODES = 16 * RADIUS_NODES
"""Period of the grid on which the kernel is computed from its spectrum. Copies of the kernel lie that far apart."""


def relief_texture(height_m: np.ndarray) -> np.ndarray:
    """Return the texture of a heightfield, metres per node^``EXPONENT``.

    Parameters
    ----------
    height_m
        float32 (rows + 2 ``RADIUS_NODES``, cols + 2 ``RADIUS_NODES``), metres: the nodes and their surroundings. NaN without
        ground.

    Returns
    -------
    numpy.ndarray
        float32 (rows, cols). Missing ground counts as level with the node; 0 at nodes without ground.
    """
    from scipy.signal import fftconvolve

    known = np.isfinite(height_m)
    inside = slice(RADIUS_NODES, -RADIUS_NODES), slice(RADIUS_NODES, -RADIUS_NODES)
    if not known[inside].any():
        return np.zeros(height_m[inside].shape, np.float32)
    middle_m = np.mean(height_m[known], dtype=np.float64).astype(np.float32)
    relative_m = np.where(known, height_m - middle_m, np.float32(0.0))
    texture = fftconvolve(relative_m, texture_kernel(), mode="valid")
    if not known.all():
        texture -= relative_m[inside] * fftconvolve(known.astype(np.float32), texture_kernel(), mode="valid")
        texture[~known[inside]] = 0.0
    return texture.astype(np.float32, copy=False)


@cached("process", MIB)
def texture_kernel() -> np.ndarray:
    """Return the kernel of the texture, float32 (2 ``RADIUS_NODES`` + 1,) * 2. Its values add up to 0."""
    frequency = np.hypot(np.fft.fftfreq(_KERNEL_PERIOD_NODES)[:, None], np.fft.rfftfreq(_KERNEL_PERIOD_NODES))
    kernel = np.fft.irfft2(frequency**EXPONENT, (_KERNEL_PERIOD_NODES, _KERNEL_PERIOD_NODES))
    offset = np.arange(-RADIUS_NODES, RADIUS_NODES + 1)
    distance = np.hypot(offset[:, None], offset)
    taper = np.cos(0.5 * np.pi * np.minimum(distance / RADIUS_NODES, 1.0)) ** 2
    kernel = kernel[np.ix_(offset, offset)] * taper
    # The correction of the sum is spread out, so that it changes the response to wide landforms only.
    return (kernel - kernel.sum() / taper.sum() * taper).astype(np.float32)


def max_texture_per_slope() -> float:
    """Return an upper bound of the texture per node on ground whose slopes (tangents) are 1 at most.

    Opposite nodes of the kernel have the same weight, so a plane has no texture. Heights at a distance d differ by d at most.
    """
    offset = np.arange(-RADIUS_NODES, RADIUS_NODES + 1)
    return float((np.abs(texture_kernel()) * np.hypot(offset[:, None], offset)).sum())
