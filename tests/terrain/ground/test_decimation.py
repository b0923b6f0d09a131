"""Decimated grids: conforming, with an exact outline and a bounded error. Simple surfaces have closed-form results."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from skugga.terrain.errors import InputError
from skugga.terrain.geo.world import EARTH_RADIUS_M
from skugga.terrain.ground.decimation import DecimatedMesh, NodeErrors, decimate, node_errors

UNLIMITED_TRIANGLES = 10**9
SPACING_M = 30.0


def fractal(rows: int, cols: int, seed: int = 0, relief_m: float = 800.0) -> np.ndarray:
    """Return heights of a random surface with a power spectrum like that of terrain."""
    n = max(rows, cols)
    frequency = np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n))
    frequency[0, 0] = np.inf
    noise = np.fft.rfft2(np.random.default_rng(seed).normal(size=(n, n)))
    height = np.fft.irfft2(noise * frequency**-1.9, (n, n))[:rows, :cols]
    return (relief_m * (height - height.min()) / np.ptp(height)).astype(np.float32)


def half_cells(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all half cells (n, 3, 2) as rows and columns, counter-clockwise from above, and which of them have three valid
    corners.

    The diagonals meet at the nodes with an even row and column.
    """
    row, col = (v.ravel() for v in np.mgrid[: height.shape[0] - 1, : height.shape[1] - 1])
    northwest, northeast, southwest, southeast = (np.stack([row + i, col + j], -1) for i in (0, 1) for j in (0, 1))
    falling = ((row + col) % 2 == 0)[:, None, None]
    first = np.where(falling, np.stack([northwest, southwest, southeast], 1), np.stack([northwest, southwest, northeast], 1))
    second = np.where(falling, np.stack([northwest, southeast, northeast], 1), np.stack([southwest, southeast, northeast], 1))
    corners = np.concatenate([first, second])
    return corners, np.isfinite(height[corners[..., 0], corners[..., 1]]).all(axis=1)


def double_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return twice the area of triangles of (row, col), positive if counter-clockwise from above (east = col, north = -row)."""
    return (b[..., 1] - a[..., 1]) * (a[..., 0] - c[..., 0]) - (c[..., 1] - a[..., 1]) * (a[..., 0] - b[..., 0])


def directed_edges(corners: np.ndarray) -> np.ndarray:
    """Return the directed edges (3 m, 2, 2) of triangles (m, 3, 2)."""
    return np.stack([corners, np.roll(corners, -1, axis=1)], 2).reshape(-1, 2, 2)


def outline(corners: np.ndarray) -> np.ndarray:
    """Return the sorted boundary edges (n, 4), split at every grid node.

    A boundary edge is a directed edge that no other triangle has in the opposite direction.
    """
    directed = directed_edges(corners).reshape(-1, 4)
    place = np.array([2**48, 2**32, 2**16, 1])
    boundary_edges = directed[~np.isin(directed @ place, directed[:, [2, 3, 0, 1]] @ place)]
    steps = abs(boundary_edges[:, 2:] - boundary_edges[:, :2]).max(axis=1, initial=0)
    offset = (np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps))[:, None]
    start, unit = (
        np.repeat(v, steps, axis=0) for v in (boundary_edges[:, :2], np.sign(boundary_edges[:, 2:] - boundary_edges[:, :2]))
    )
    return np.unique(np.concatenate([start + offset * unit, start + (offset + 1) * unit], axis=1), axis=0)


def assert_conforming(height: np.ndarray, mesh: DecimatedMesh) -> None:
    """Assert a conforming mesh without T-junctions.

    Triangles are counter-clockwise, each directed edge occurs once, and unpaired edges occur only where the full grid has them.
    """
    corners = mesh.nodes[mesh.triangles].astype(np.int64)
    halves, is_complete = half_cells(height)
    area = double_area(*np.moveaxis(corners, 1, 0))
    assert (area > 0).all()
    assert area.sum() == is_complete.sum()
    directed = directed_edges(corners).reshape(-1, 4)
    assert len(np.unique(directed, axis=0)) == len(directed)
    np.testing.assert_array_equal(outline(corners), outline(halves[is_complete]))
    np.testing.assert_array_equal(np.unique(mesh.triangles), np.arange(len(mesh.nodes)))
    assert len(np.unique(mesh.nodes, axis=0)) == len(mesh.nodes)


def times_covered(height: np.ndarray, mesh: DecimatedMesh) -> np.ndarray:
    """Return how many triangles cover the centre of each half cell (exact, in thirds of cells)."""
    middle = half_cells(height)[0].sum(axis=1)
    a, b, c = np.moveaxis(3 * mesh.nodes[mesh.triangles].astype(np.int64), 1, 0)[:, None]
    m = middle[:, None]
    return ((double_area(a, b, m) > 0) & (double_area(b, c, m) > 0) & (double_area(c, a, m) > 0)).sum(axis=1)


def deviation_m(height: np.ndarray, mesh: DecimatedMesh) -> np.ndarray:
    """Return the distance of the decimated surface from each node (rows, cols), NaN without a surface."""
    out = np.full(height.shape, np.nan)
    for corners in mesh.nodes[mesh.triangles].astype(np.int64):
        (r0, c0), (r1, c1) = corners.min(axis=0), corners.max(axis=0)
        p = np.stack(np.mgrid[r0 : r1 + 1, c0 : c1 + 1], -1)
        a, b, c = corners
        weight = np.stack([double_area(b, c, p), double_area(c, a, p), double_area(a, b, p)], -1) / double_area(a, b, c)
        is_inside = (weight >= 0).all(axis=-1)
        flat = weight @ height[corners[:, 0], corners[:, 1]].astype(float)
        out[p[is_inside][:, 0], p[is_inside][:, 1]] = np.abs(flat - height[r0 : r1 + 1, c0 : c1 + 1])[is_inside]
    return out


def hypotenuse(row: int, col: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the ends of the hypotenuse that a node bisects, from the lowest set bits of its row and column."""
    step = (row | col) & -(row | col)
    if row & step and col & step:
        # The diagonal ends in the centre of the square of twice the size, where both indices are odd multiples of twice the step.
        down, right = (step if v & 2 * step == 0 else -step for v in (row, col))
    else:
        down, right = (step, 0) if row & step else (0, step)
    return (row - down, col - right), (row + down, col + right)


def distance_m(height: np.ndarray, eye: tuple[float, float, float], min_distance_m: float = 1.0) -> np.ndarray:
    """Return the distances (rows, cols) of nodes from an eye: row, column and height in metres."""
    row, col = np.mgrid[: height.shape[0], : height.shape[1]]
    plan_distance_m = np.hypot(row - eye[0], col - eye[1]) * SPACING_M
    return np.maximum(np.hypot(plan_distance_m, np.nan_to_num(height - eye[2])), min_distance_m)


@st.composite
def surfaces(draw) -> np.ndarray:
    """Draw heights in quarter metres on grids of any shape, with any share of holes."""
    rows, cols = draw(st.integers(1, 19)), draw(st.integers(1, 19))
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    slope = np.add.outer(np.arange(rows), np.arange(cols))
    height = (rng.integers(0, draw(st.sampled_from([1, 3, 400])), (rows, cols)) / 4 + slope).astype(np.float32)
    if draw(st.booleans()):
        height[rng.random((rows, cols)) < draw(st.sampled_from([0.02, 0.2, 0.6, 1.0]))] = np.nan
    else:
        row, col = rng.integers(0, rows), rng.integers(0, cols)
        height[row : row + rng.integers(0, 9), col : col + rng.integers(0, 9)] = draw(st.sampled_from([np.nan, np.inf]))
    return height


eyes = st.tuples(st.floats(-30, 50), st.floats(-30, 50), st.floats(-100, 2000))
tolerances = st.one_of(st.just(0.0), st.floats(1e-4, 0.3))


@settings(max_examples=200, deadline=None)
@given(surfaces(), eyes, tolerances, st.sampled_from([UNLIMITED_TRIANGLES, 40, 8]), st.booleans())
def test_decimate_is_conforming_with_an_exact_outline(height, eye, tolerance, max_triangles, is_curved):
    mesh = decimate(node_errors(height, SPACING_M, is_curved), eye, tolerance, max_triangles)
    assert_conforming(height, mesh)
    if height.size > 1:
        np.testing.assert_array_equal(times_covered(height, mesh), half_cells(height)[1])


@settings(max_examples=100, deadline=None)
@given(surfaces(), eyes)
def test_zero_tolerance_keeps_every_node_with_an_error(height, eye):
    errors = node_errors(height, SPACING_M, False)
    mesh = decimate(errors, eye, 0.0, UNLIMITED_TRIANGLES)
    is_kept = np.zeros(height.shape, bool)
    is_kept[tuple(mesh.nodes.T)] = True
    assert is_kept[(errors.error_m > 0) & np.isfinite(errors.error_m)].all()
    # Heights are in quarter metres and corners at most 16 cells apart, so the planes between them are exact.
    assert np.nanmax(deviation_m(height, mesh), initial=0.0) == 0.0


@settings(max_examples=100, deadline=None)
@given(surfaces(), eyes, tolerances)
def test_deviation_is_bounded_by_the_sum_of_omitted_errors(height, eye, tolerance):
    errors = node_errors(height, SPACING_M, False)
    mesh = decimate(errors, eye, tolerance, UNLIMITED_TRIANGLES)
    assert mesh.tolerance_rad == tolerance
    deviation, share = deviation_m(height, mesh), tolerance * distance_m(height, eye)
    used_nodes = set(map(tuple, mesh.nodes.tolist()))
    bound = {}

    def bound_m(node: tuple[int, int]) -> float:
        """Return 0 for a kept node, else its tolerated error plus the mean bound of the ends of its hypotenuse."""
        if node not in bound:
            is_omitted = node not in used_nodes and np.isfinite(deviation[node])
            bound[node] = share[node] + sum(bound_m(end) for end in hypotenuse(*node)) / 2 if is_omitted else 0.0
        return bound[node]

    for node in np.argwhere(np.isfinite(deviation)).tolist():
        assert deviation[tuple(node)] <= bound_m(tuple(node)) + 1e-4


@pytest.mark.parametrize("eye", [(0.0, 0.0, 300.0), (64.5, 48.2, 900.0), (200.0, -80.0, 3000.0)])
@pytest.mark.parametrize("tolerance", [0.003, 0.02])
def test_deviation_on_terrain_is_below_twice_the_tolerance(eye, tolerance):
    height = fractal(129, 100, seed=3)
    errors = node_errors(height, SPACING_M, False)
    mesh = decimate(errors, eye, tolerance, UNLIMITED_TRIANGLES)
    ratio = deviation_m(height, mesh) / distance_m(height, eye)
    assert len(mesh.triangles) < 0.75 * errors.triangle_count
    assert ratio.max() <= 2.0 * tolerance


def test_far_node_that_bends_the_ground_at_the_eye_is_kept():
    row, col = np.mgrid[:65, :65]
    pyramid = np.float32(1.0) - np.maximum(abs(row - 32), abs(col - 32)).astype(np.float32) / 32
    errors = node_errors(pyramid, SPACING_M, False)
    assert np.argwhere(errors.error_m > 0).tolist() == [[32, 32]]
    tolerance = 2.0 / (30 * SPACING_M)  # the peak is 1 m high, so its error seen from the rim is below the tolerance
    assert len(decimate(errors, (2.0, 32.0, 100.0), tolerance, UNLIMITED_TRIANGLES).triangles) == 2
    assert len(decimate(errors, (16.0, 32.0, 100.0), tolerance, UNLIMITED_TRIANGLES).triangles) == 4


def test_distances_count_as_at_least_min_distance_m():
    height = np.zeros((3, 3), np.float32)
    height[1, 1] = 1.0
    errors = node_errors(height, SPACING_M, False)
    assert len(decimate(errors, (1.0, 1.0, 1.0), 0.09, UNLIMITED_TRIANGLES, min_distance_m=10.0).triangles) == 4
    assert len(decimate(errors, (1.0, 1.0, 1.0), 0.11, UNLIMITED_TRIANGLES, min_distance_m=10.0).triangles) == 2


def test_node_errors_of_single_peaks():
    height = np.zeros((5, 5), np.float32)
    height[2, 2], height[1, 2] = 4.0, 1.0
    error = node_errors(height, SPACING_M, False).error_m
    expected = np.zeros((5, 5))
    expected[2, 2] = 4.0  # the diagonal of the whole grid
    expected[1, 1] = expected[1, 3] = expected[3, 1] = expected[3, 3] = 2.0  # diagonals from (2, 2) to the corners
    expected[1, 2] = 1.0 - 2.0  # from (0, 2) to (2, 2)
    expected[2, 1] = expected[2, 3] = expected[3, 2] = 2.0
    np.testing.assert_array_equal(error, abs(expected))


def test_node_errors_include_the_sagitta_of_the_earth():
    error = node_errors(np.zeros((129, 129)), 90.0, True).error_m
    for node, cells in {(64, 64): 128 * np.sqrt(2), (0, 64): 128, (32, 32): 64 * np.sqrt(2), (1, 0): 2}.items():
        assert error[node] == pytest.approx((cells * 90.0) ** 2 / (8 * EARTH_RADIUS_M), rel=1e-6)


@pytest.mark.parametrize(("rows", "cols", "triangles"), [(65, 65, 2), (129, 65, 3), (65, 129, 3), (2, 2, 2), (9, 25, 5)])
def test_plane_needs_a_handful_of_triangles(rows, cols, triangles):
    height = np.add.outer(-0.25 * np.arange(rows), 0.5 * np.arange(cols))
    mesh = decimate(node_errors(height, SPACING_M, False), (10.0, 10.0, 1000.0), 0.0, UNLIMITED_TRIANGLES)
    assert_conforming(height, mesh)
    assert len(mesh.triangles) == triangles


def test_hole_in_a_plane_keeps_only_its_corners():
    height = np.zeros((65, 65), np.float32)
    height[17:32, 33:48] = np.nan
    mesh = decimate(node_errors(height, SPACING_M, False), (0.0, 0.0, 100.0), 0.1, UNLIMITED_TRIANGLES)
    assert_conforming(height, mesh)
    assert len(mesh.triangles) < 40


@pytest.fixture(scope="module")
def mountains() -> NodeErrors:
    """Node errors of fractal mountains with holes."""
    height = fractal(150, 211, seed=5)
    height[fractal(150, 211, seed=6) > 650.0] = np.nan
    return node_errors(height, SPACING_M, True)


@pytest.mark.parametrize("max_triangles", [5_000, 10_000, 25_000])
def test_max_triangles_selects_the_smallest_tolerance_that_fits(mountains, max_triangles):
    eye = (75.0, 100.0, 700.0)
    mesh = decimate(mountains, eye, 1e-5, max_triangles)
    assert 0.99 * max_triangles <= len(mesh.triangles) <= max_triangles
    assert_conforming(mountains.height_m, mesh)
    repeated_mesh = decimate(mountains, eye, mesh.tolerance_rad, UNLIMITED_TRIANGLES)
    np.testing.assert_array_equal(repeated_mesh.triangles, mesh.triangles)
    lower_tolerance = float(np.nextafter(np.float32(mesh.tolerance_rad), np.float32(0.0)))
    assert len(decimate(mountains, eye, lower_tolerance, UNLIMITED_TRIANGLES).triangles) > max_triangles


def test_outline_is_kept_even_beyond_max_triangles(mountains):
    mesh, outline_alone = (decimate(mountains, (0.0, 0.0, 100.0), t, m) for t, m in ((0.001, 1), (1e9, UNLIMITED_TRIANGLES)))
    np.testing.assert_array_equal(mesh.triangles, outline_alone.triangles)
    assert_conforming(mountains.height_m, mesh)
    assert 0.001 < mesh.tolerance_rad < 1e9


def test_triangles_are_reproducible_and_finer_near_the_eye(mountains):
    meshes = [decimate(mountains, eye, 0.01, 20_000) for eye in ((140.0, 5.0, 500.0), (140.0, 5.0, 500.0), (5.0, 205.0, 500.0))]
    np.testing.assert_array_equal(meshes[0].triangles, meshes[1].triangles)
    np.testing.assert_array_equal(meshes[0].nodes, meshes[1].nodes)
    near = [np.count_nonzero((mesh.nodes[:, 0] > 100) & (mesh.nodes[:, 1] < 50)) for mesh in meshes[1:]]
    assert near[0] > 2 * near[1]


@pytest.mark.parametrize("shape", [(0, 0), (0, 5), (1, 1), (1, 9), (9, 1)])
def test_grid_without_area_has_no_triangles(shape):
    mesh = decimate(node_errors(np.ones(shape), SPACING_M, True), (0.0, 0.0, 5.0), 0.001, 10)
    assert mesh.nodes.shape == (0, 2) and mesh.triangles.shape == (0, 3)


def test_grid_of_holes_has_no_triangles():
    mesh = decimate(node_errors(np.full((20, 30), np.nan), SPACING_M, True), (3.0, 3.0, 5.0), 0.0, 10)
    assert mesh.nodes.shape == (0, 2) and mesh.triangles.shape == (0, 3)


def test_strip_needs_no_square_memory():
    height = fractal(3, 2000)
    height = np.tile(height, (1, 100))
    mesh = decimate(node_errors(height, SPACING_M, False), (1.0, 1e5, 100.0), 0.01, UNLIMITED_TRIANGLES)
    corners = mesh.nodes[mesh.triangles].astype(np.int64)
    assert double_area(*np.moveaxis(corners, 1, 0)).sum() == 2 * 2 * (height.shape[1] - 1)


def test_raster_with_holes_is_conforming(shared_data):
    with rasterio.open(shared_data / "mountain" / "vinschgau_250m_utm32.tif") as dataset:
        height = dataset.read(1, masked=True).filled(np.nan)
    errors = node_errors(height, 250.0, True)
    mesh = decimate(errors, (100.0, 100.0, 4000.0), 0.005, UNLIMITED_TRIANGLES)
    assert_conforming(height, mesh)
    assert len(mesh.triangles) < 0.5 * errors.triangle_count


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"eye": (np.nan, 0.0, 0.0)}, "eye_row_col_m"),
        ({"tolerance": -0.1}, "tolerance"),
        ({"tolerance": np.nan}, "tolerance"),
        ({"max_triangles": 0}, "max_triangles"),
        ({"min_distance_m": 0.0}, "min_distance_m"),
        ({"spacing_m": 0.0}, "spacing_m"),
        ({"height": np.zeros(5)}, "heights_m"),
    ],
)
def test_invalid_arguments_are_named(change, named):
    right = {
        "height": np.zeros((5, 5)),
        "spacing_m": 1.0,
        "eye": (0, 0, 1),
        "tolerance": 0.1,
        "max_triangles": 10,
        "min_distance_m": 1.0,
    }
    v = right | change
    with pytest.raises(InputError, match=named):
        decimate(node_errors(v["height"], v["spacing_m"], False), v["eye"], v["tolerance"], v["max_triangles"], v["min_distance_m"])


@pytest.mark.parametrize("eye", [(128.0, 128.0, 2.0), (100.3, 171.8, 2.0), (0.0, 0.0, 5.0), (31.999, 64.0, 30.0)])
def test_triangles_near_the_eye_fit_float32_precision(eye):
    """Level ground of 256 km would be two triangles, with corners 100 km from a pebble in front of the eye."""
    errors = node_errors(np.zeros((257, 257), np.float32), 1000.0, False)
    low, high = (decimate(errors, (*eye[:2], height), 0.001, UNLIMITED_TRIANGLES) for height in (eye[2], 60_000.0))
    assert len(high.triangles) == 2 and len(low.triangles) < 200
    assert_conforming(errors.height_m, low)
    corners = low.nodes[low.triangles].astype(float)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
    eye_distance_m = shapely.distance(shapely.polygons(corners), shapely.Point(eye[:2]))
    near = sides[eye_distance_m <= sides / 64.0]
    assert len(near) and near.max() <= max(64.0 * eye[2] / 1000.0, 2.0**0.5) * (1.0 + 1e-9)
