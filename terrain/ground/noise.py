"""Compute reproducible gradient noise on a plane. A position and a seed give the same number on any machine.

The method is that of Perlin (1985, "An image synthesizer", SIGGRAPH 19(3):287-296) with his later quintic fade (2002, "Improving
noise", ACM TOG 21(3):681-682), on a lattice of hashed gradients. It calls no transcendental function.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, internal

OCTAVE_GAIN = 0.5
"""Amplitude of an octave as a share of the previous octave's."""


@internal
def hash_lattice_point(i, j, seed):
    """Return the 32-bit hash of a lattice point: two rounds of MurmurHash3's finaliser (Appleby, public domain).

    Products are of 64 bits.
    """
    low = np.uint64(0xFFFFFFFF)
    h = np.uint64(np.uint32(seed)) ^ (np.uint64(np.uint32(i)) * np.uint64(0x9E3779B1))
    for k in range(2):
        h = ((h ^ (h >> np.uint64(16))) & low) * np.uint64(0x85EBCA6B)
        h = ((h ^ (h >> np.uint64(13))) & low) * np.uint64(0xC2B2AE35)
        h = (h ^ (h >> np.uint64(16))) & low
        if k == 0:
            h = (h ^ (np.uint64(np.uint32(j)) * np.uint64(0x27D4EB2F))) & low
    return np.uint32(h)


@internal
def _gradient_dot(h, x, y):
    """Return the dot product of (x, y) with a lattice point's gradient, chosen by its hash.

    The eight gradients are parallel to no axis and no diagonal.
    """
    long = x if h & np.uint32(1) else y
    short = y if h & np.uint32(1) else x
    return (long if h & np.uint32(2) else -long) + 0.5 * (short if h & np.uint32(4) else -short)


@compiled
def noise_at(x, y, seed):
    """Return gradient noise of wavelength 1 at a position within 2^31 of the origin: about -0.8 to 0.8, 0 at integer positions."""
    west, low, one = np.floor(x), np.floor(y), np.int32(1)
    i, j = np.int32(west), np.int32(low)
    x, y = x - west, y - low
    u = x * x * x * (x * (x * 6.0 - 15.0) + 10.0)
    v = y * y * y * (y * (y * 6.0 - 15.0) + 10.0)
    south = _gradient_dot(hash_lattice_point(i, j, seed), x, y)
    south += u * (_gradient_dot(hash_lattice_point(i + one, j, seed), x - 1.0, y) - south)
    north = _gradient_dot(hash_lattice_point(i, j + one, seed), x, y - 1.0)
    north += u * (_gradient_dot(hash_lattice_point(i + one, j + one, seed), x - 1.0, y - 1.0) - north)
    return south + v * (north - south)


@compiled
def noise_along(x, y, seed, out):
    """Fill ``out`` (n,) with ``noise_at`` of the positions ``x``, ``y`` (n,).

    The code repeats ``noise_at``: a loop that calls it does not compile to vector instructions.
    """
    one = np.int32(1)
    for n in range(out.size):
        west, low = np.floor(x[n]), np.floor(y[n])
        i, j = np.int32(west), np.int32(low)
        a, b = x[n] - west, y[n] - low
        u = a * a * a * (a * (a * 6.0 - 15.0) + 10.0)
        v = b * b * b * (b * (b * 6.0 - 15.0) + 10.0)
        south = _gradient_dot(hash_lattice_point(i, j, seed), a, b)
        south += u * (_gradient_dot(hash_lattice_point(i + one, j, seed), a - 1.0, b) - south)
        north = _gradient_dot(hash_lattice_point(i, j + one, seed), a, b - 1.0)
        north += u * (_gradient_dot(hash_lattice_point(i + one, j + one, seed), a - 1.0, b - 1.0) - north)
        out[n] = south + v * (north - south)


@internal
def _gradient(h):
    """Return the gradient of a lattice point with a hash, whose dot product is ``_gradient_dot``."""
    long = 1.0 if h & np.uint32(2) else -1.0
    short = 0.5 if h & np.uint32(4) else -0.5
    return (long, short) if h & np.uint32(1) else (short, long)


@internal
def noise_slopes_at(x, y, seed):
    """Return ``noise_at`` and its derivatives with respect to ``x`` and ``y``, which are continuous and at most 2.5 or so."""
    west, low, one = np.floor(x), np.floor(y), np.int32(1)
    i, j = np.int32(west), np.int32(low)
    x, y = x - west, y - low
    u, u_slope = x * x * x * (x * (x * 6.0 - 15.0) + 10.0), 30.0 * x * x * (x - 1.0) * (x - 1.0)
    v, v_slope = y * y * y * (y * (y * 6.0 - 15.0) + 10.0), 30.0 * y * y * (y - 1.0) * (y - 1.0)
    ax, ay = _gradient(hash_lattice_point(i, j, seed))
    bx, by = _gradient(hash_lattice_point(i + one, j, seed))
    cx, cy = _gradient(hash_lattice_point(i, j + one, seed))
    dx, dy = _gradient(hash_lattice_point(i + one, j + one, seed))
    a, b = ax * x + ay * y, bx * (x - 1.0) + by * y
    c, d = cx * x + cy * (y - 1.0), dx * (x - 1.0) + dy * (y - 1.0)
    south, north = a + u * (b - a), c + u * (d - c)
    south_x, north_x = ax + u * (bx - ax) + u_slope * (b - a), cx + u * (dx - cx) + u_slope * (d - c)
    south_y, north_y = ay + u * (by - ay), cy + u * (dy - cy)
    return (
        south + v * (north - south),
        south_x + v * (north_x - south_x),
        south_y + v * (north_y - south_y) + v_slope * (north - south),
    )


@internal
def noise_slopes_along(x, y, seed, out, out_x, out_y):
    """Fill ``out``, ``out_x`` and ``out_y`` (n,) with ``noise_slopes_at`` of the positions ``x``, ``y`` (n,).

    The code repeats ``noise_slopes_at``: a loop that calls it does not compile to vector instructions.
    """
    one = np.int32(1)
    for n in range(out.size):
        west, low = np.floor(x[n]), np.floor(y[n])
        i, j = np.int32(west), np.int32(low)
        p, q = x[n] - west, y[n] - low
        u, u_slope = p * p * p * (p * (p * 6.0 - 15.0) + 10.0), 30.0 * p * p * (p - 1.0) * (p - 1.0)
        v, v_slope = q * q * q * (q * (q * 6.0 - 15.0) + 10.0), 30.0 * q * q * (q - 1.0) * (q - 1.0)
        h = hash_lattice_point(i, j, seed)
        ax, ay = _gradient_dot(h, 1.0, 0.0), _gradient_dot(h, 0.0, 1.0)
        h = hash_lattice_point(i + one, j, seed)
        bx, by = _gradient_dot(h, 1.0, 0.0), _gradient_dot(h, 0.0, 1.0)
        h = hash_lattice_point(i, j + one, seed)
        cx, cy = _gradient_dot(h, 1.0, 0.0), _gradient_dot(h, 0.0, 1.0)
        h = hash_lattice_point(i + one, j + one, seed)
        dx, dy = _gradient_dot(h, 1.0, 0.0), _gradient_dot(h, 0.0, 1.0)
        a, b = ax * p + ay * q, bx * (p - 1.0) + by * q
        c, d = cx * p + cy * (q - 1.0), dx * (p - 1.0) + dy * (q - 1.0)
        south, north = a + u * (b - a), c + u * (d - c)
        south_x, north_x = ax + u * (bx - ax) + u_slope * (b - a), cx + u * (dx - cx) + u_slope * (d - c)
        south_y, north_y = ay + u * (by - ay), cy + u * (dy - cy)
        out[n] = south + v * (north - south)
        out_x[n] = south_x + v * (north_x - south_x)
        out_y[n] = south_y + v * (north_y - south_y) + v_slope * (north - south)


@internal
def fractal_at(x, y, octaves, seed):
    """Return fractal noise at a position: octaves of gradient noise, the first of wavelength 1, about -1 to 1.

    Each octave is rotated, so the lattice does not show.
    """
    total, amplitude = 0.0, 1.0
    for k in range(octaves):
        total += amplitude * noise_at(x, y, seed + k)
        # Half the wavelength, rotated by the angle of the 3-4-5 triangle, whose sine and cosine are exact (0.6 and 0.8).
        x, y = 2.0 * (0.8 * x - 0.6 * y) + 17.3, 2.0 * (0.6 * x + 0.8 * y) - 9.1
        amplitude *= OCTAVE_GAIN
    return total


@internal
def ridged_at(x, y, octaves, seed):
    """Return ridged multifractal noise, the first octave of wavelength 1: about 0 to 2, with sharp crests and smooth floors.

    Source: F. K. Musgrave, in Ebert et al., *Texturing and Modeling: A Procedural Approach* (3rd ed., 2003), chapter 16.
    """
    total, amplitude, weight = 0.0, 1.0, 1.0
    for k in range(octaves):
        crest = 1.0 - min(1.6 * abs(noise_at(x, y, seed + k)), 1.0)
        crest *= crest * weight
        total += amplitude * crest
        weight = min(2.0 * crest, 1.0)
        x, y = 2.0 * (0.8 * x - 0.6 * y) + 17.3, 2.0 * (0.6 * x + 0.8 * y) - 9.1
        amplitude *= OCTAVE_GAIN
    return total


@compiled
def fractal_grid(x, y, octaves, seed):
    """Return ``fractal_at`` on a grid of columns x (n,) and rows y (m,): float64 (m, n)."""
    out = np.empty((y.shape[0], x.shape[0]))
    for i in range(y.shape[0]):
        for j in range(x.shape[0]):
            out[i, j] = fractal_at(x[j], y[i], octaves, seed)
    return out
