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

KERNEL_SCALE = 2.0**20
"""Factor of the kernel's values before they are rounded. Their largest is 0.46, those at the edge are some millionths."""

_KERNEL_PERIOD_NODES = 16 * RADIUS_NODES
"""Period of the grid on which the kernel is computed from its spectrum. Copies of the kernel lie that far apart."""


def relief_texture(height_m: np.ndarray, height_step_m: float) -> np.ndarray:
    """Return the texture of a heightfield, metres per node^``EXPONENT``.

    Heights and kernel are rounded to integers, and so is their convolution by Fourier transforms, which is then exact. So a node
    has the same texture to the bit in all windows, and ground beyond the radius has no effect.

    Parameters
    ----------
    height_m
        float32 (rows + 2 ``RADIUS_NODES``, cols + 2 ``RADIUS_NODES``), metres: the nodes and their surroundings. NaN without
        ground.
    height_step_m
        Step to which heights are rounded, metres: a small part of the distance between nodes.

    Returns
    -------
    numpy.ndarray
        float32 (rows, cols). Missing ground counts as level with the node; 0 at nodes without ground.
    """
    known = np.isfinite(height_m)
    inside = slice(RADIUS_NODES, -RADIUS_NODES), slice(RADIUS_NODES, -RADIUS_NODES)
    if not known[inside].any():
        return np.zeros(height_m[inside].shape, np.float32)
    steps = np.rint(np.where(known, height_m, np.nan).astype(np.float64) / height_step_m)
    steps -= np.rint(np.nanmean(steps))  # any whole number serves: the kernel's values add up to 0
    steps[~known] = 0.0
    texture = _convolve_exactly(steps)
    if not known.all():
        texture -= steps[inside] * _convolve_exactly(known.astype(np.float64))
        texture[~known[inside]] = 0.0
    return (texture * (height_step_m / KERNEL_SCALE)).astype(np.float32)


def _convolve_exactly(values: np.ndarray) -> np.ndarray:
    """Return the convolution of whole numbers, float64 (rows, cols), with the kernel, where its radius lies within the array."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    rows, cols = values.shape
    shape = next_fast_len(rows, real=True), next_fast_len(cols, real=True)
    spectrum = rfft2(values, shape)
    spectrum *= _kernel_spectrum(shape)
    return np.rint(irfft2(spectrum, shape, overwrite_x=True)[2 * RADIUS_NODES : rows, 2 * RADIUS_NODES : cols])


@cached("process", 48 * MIB)
def _kernel_spectrum(shape: tuple[int, int]) -> np.ndarray:
    """Return the spectrum of the kernel on a grid of a shape, complex128. Values that wrap round it are not used."""
    from scipy.fft import rfft2

    return np.asarray(rfft2(texture_kernel(), shape))


@cached("process", MIB)
def texture_kernel() -> np.ndarray:
    """Return the kernel of the texture times ``KERNEL_SCALE``, rounded: float64 (2 ``RADIUS_NODES`` + 1,) * 2. Its sum is 0."""
    frequency = np.hypot(np.fft.fftfreq(_KERNEL_PERIOD_NODES)[:, None], np.fft.rfftfreq(_KERNEL_PERIOD_NODES))
    kernel = np.fft.irfft2(frequency**EXPONENT, (_KERNEL_PERIOD_NODES, _KERNEL_PERIOD_NODES))
    offset = np.arange(-RADIUS_NODES, RADIUS_NODES + 1)
    distance = np.hypot(offset[:, None], offset)
    taper = np.cos(0.5 * np.pi * np.minimum(distance / RADIUS_NODES, 1.0)) ** 2
    kernel = kernel[np.ix_(offset, offset)] * taper
    # The correction of the sum is spread out, so that it changes the response to wide landforms only.
    kernel = np.rint(KERNEL_SCALE * (kernel - kernel.sum() / taper.sum() * taper))
    kernel[RADIUS_NODES, RADIUS_NODES] -= kernel.sum()
    return np.asarray(kernel)


def max_texture_per_slope() -> float:
    """Return an upper bound of the texture per node on ground whose slopes (tangents) are 1 at most.

    Opposite nodes of the kernel have the same weight, so a plane has no texture. Heights at a distance d differ by d at most.
    """
    offset = np.arange(-RADIUS_NODES, RADIUS_NODES + 1)
    return float((np.abs(texture_kernel()) * np.hypot(offset[:, None], offset)).sum()) / KERNEL_SCALE
