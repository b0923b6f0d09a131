"""Cubics that give the positions of sweep lines on a sun-aligned grid, and the errors for rays that bend too much for them.

The position of a line across the rays is *t*, in cells. A cubic polynomial per row converts t to columns of the row, and one
converts back.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from skugga.terrain.errors import UnsupportedError

LATTICE_SIZE = 17
"""Maximum number of rows, and of columns, at which the positions of lines are computed by PROJ. Others are interpolated."""

MAX_BEND_CELLS = 0.1
"""Tolerance in cells for the distance of the lines from their fitted cubics."""

RAYS_BEND_REASON = "the sun's rays bend across the view; shadow_map can draw it"
"""The reason with which the sweep refuses rays that are not straight in the view's CRS."""


def bent_rays_error(crs_name: str) -> UnsupportedError:
    """Return the error for a view across which the sun's rays bend. The message names the CRS."""
    return UnsupportedError("algorithm", "sweep", f"in the CRS '{crs_name}' {RAYS_BEND_REASON}")


def beyond_crs_error(crs_name: str) -> UnsupportedError:
    """Return the error for a view that reaches beyond the area where its CRS is defined. The message names the CRS."""
    reason = f"the view reaches beyond the area of its CRS '{crs_name}'; shadow_map can draw it"
    return UnsupportedError("algorithm", "sweep", reason)


def position_cubics(
    t_of: Callable[[np.ndarray, np.ndarray], np.ndarray], rows: int, cols: int, crs_name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Fit cubics to each row of a sun-aligned grid that convert t to columns and columns to t: (rows, 4) each.

    t is the position across the sun's rays, in cells. ``t_of`` is a smooth function that returns t at sun-aligned rows and columns.
    The columns of the cubics count the left border column. Raises ``UnsupportedError`` if cubics cannot approximate ``t_of``. The
    message names the CRS ``crs_name``.
    """
    from scipy.interpolate import make_interp_spline

    i = np.unique(np.linspace(0, rows - 1, min(rows, LATTICE_SIZE)).round())
    j = np.linspace(0, cols - 1, min(cols, LATTICE_SIZE))
    t = t_of(*np.meshgrid(i, j, indexing="ij"))
    j = j + 1.0  # behind the left border
    if not np.isfinite(t).all():
        raise beyond_crs_error(crs_name)
    if not (np.diff(t, axis=1) > 0.0).all():  # for example a view that spans half the earth
        raise bent_rays_error(crs_name)
    columns = np.broadcast_to(j, t.shape)
    column_of_t, t_of_column = (
        make_interp_spline(i, fit_cubics(x, y), k=min(3, len(i) - 1))(np.arange(rows)) for x, y in ((t, columns), (columns, t))
    )
    checked_rows = np.unique(np.linspace(0, rows - 1, 4 * LATTICE_SIZE).round()).astype(int)
    columns = np.linspace(0, cols - 1, 4 * LATTICE_SIZE)
    exact = t_of(*np.meshgrid(checked_rows.astype(float), columns, indexing="ij"))
    c0, c1, c2, c3 = column_of_t[checked_rows].T[..., None]
    fitted = c0 + exact * (c1 + exact * (c2 + exact * c3))
    if not np.abs(fitted - columns - 1.0).max() <= MAX_BEND_CELLS:  # also raises for NaN
        raise bent_rays_error(crs_name)
    return column_of_t, t_of_column


def fit_cubics(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fit a least-squares cubic to each row of ``y`` (m, n) as a function of the same row of ``x``.

    Returns the coefficients (m, 4), constant term first.
    """
    middle, half = (x[:, :1] + x[:, -1:]) / 2, (x[:, -1:] - x[:, :1]) / 2
    half[half == 0.0] = 1.0  # cubics are fitted between -1 and 1
    powers = ((x - middle) / half)[..., None] ** np.arange(min(4, x.shape[1]))
    a = np.zeros((len(x), 4))
    a[:, : powers.shape[2]] = (np.linalg.pinv(powers) @ y[..., None])[..., 0]
    a /= half ** np.arange(4)
    (a0, a1, a2, a3), h = a.T, -middle[:, 0]
    return np.stack([a0 + h * (a1 + h * (a2 + h * a3)), a1 + h * (2.0 * a2 + h * 3.0 * a3), a2 + h * 3.0 * a3, a3], axis=1)
