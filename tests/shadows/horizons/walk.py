"""An independent horizon for tests: all crossings of one ray with the rows, columns and diagonals of a grid."""

import numpy as np


def walked_tangent(height_m, east_north_of_cell_m, row, col, azimuth_deg, curvature_per_m=0.0):
    """Return the tangent of the horizon angle of a node; -inf without ground. Ground ends at the outermost nodes.

    Between two crossings the ground is straight, so the horizon is the steepest slope to one of them.
    """
    azimuth = np.radians(azimuth_deg)
    down, right = np.linalg.inv(east_north_of_cell_m) @ (np.sin(azimuth), np.cos(azimuth))  # cells a metre
    rows, cols = height_m.shape
    best = -np.inf
    for rate in (down, right, down - right, down + right):
        if abs(rate) < 1e-15:
            continue
        distance_m = np.arange(1.0, 2.0 * (rows + cols)) / abs(rate)
        r, c = row + down * distance_m, col + right * distance_m
        inside = (r >= -1e-9) & (c >= -1e-9) & (r <= rows - 1 + 1e-9) & (c <= cols - 1 + 1e-9)
        if inside.any():
            distance_m = distance_m[inside]
            rise_m = surface_m(height_m, r[inside], c[inside]) - float(height_m[row, col])
            best = max(best, float((rise_m / distance_m - 0.5 * curvature_per_m * distance_m).max()))
    return best


def surface_m(height_m, row, col):
    """Return heights of the triangulated ground at positions (n,); each quad is cut along its higher diagonal."""
    r0 = np.clip(np.floor(row).astype(int), 0, height_m.shape[0] - 2)
    c0 = np.clip(np.floor(col).astype(int), 0, height_m.shape[1] - 2)
    y, x = row - r0, col - c0
    a, b, c, d = (height_m[r0 + i, c0 + j].astype(float) for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
    upper_right, lower_left = a + (d - b) * y + (b - a) * x, a + (c - a) * y + (d - c) * x
    upper_left, lower_right = a + (c - a) * y + (b - a) * x, d + (b - d) * (1.0 - y) + (c - d) * (1.0 - x)
    return np.where(a + d >= b + c, np.where(x >= y, upper_right, lower_left), np.where(x + y <= 1.0, upper_left, lower_right))
