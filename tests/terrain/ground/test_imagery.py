"""Imagery draped over the ground: georeferenced colours, averaged for coarse pixels, with the tint where imagery is missing."""

from __future__ import annotations

import numpy as np
import pytest
import rasterio
from affine import Affine
from pyproj import CRS, Transformer
from scipy.ndimage import map_coordinates

from skugga.terrain.errors import SourceError
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.ground.imagery import Imagery
from skugga.terrain.meshes.body import srgb_albedo
from skugga.terrain.scene import Scene
from skugga.terrain.shading import FLAT_GROUND_ALBEDO
from tests.rasters import ENGINEERING
from tests.render import render

UTM = "EPSG:32633"
X0, Y0 = 450_000.0, 6_000_000.0
SIDE, CELL = 16, 25.0
"""Cells along a side of the imagery and their size in metres: it covers the 400 m of the DEM."""


@pytest.fixture
def hill(write_raster):
    """File of a raster of a round hill."""
    y, x = np.mgrid[0:41, 0:41] / 40.0
    heights = 100 + 30 * np.exp(-8 * ((x - 0.5) ** 2 + (y - 0.5) ** 2))
    return write_raster(heights.astype(np.float32), UTM, X0, Y0, 10.0)


def random_colors(seed: int = 1) -> np.ndarray:
    """Return a random picture, uint8 (3, ``SIDE``, ``SIDE``)."""
    return np.random.default_rng(seed).integers(0, 256, (3, SIDE, SIDE)).astype(np.uint8)


def bilinear(data: np.ndarray, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Return the linear albedo (..., 3) of bytes (3, rows, cols) at fractional cells, clamped at the border."""
    linear = srgb_albedo(data / 255.0).astype(float)
    return np.stack([map_coordinates(linear[k], [row, col], order=1, mode="nearest") for k in range(3)], axis=-1)


def make_draped_scene(write_raster, make_scene, dem, data: np.ndarray, crs: str = UTM, x0=X0, y0=Y0, cell=CELL, **keys) -> Scene:
    """Return the scene of a level with imagery, which is written to its own file."""
    options = {key: keys.pop(key) for key in ("nodata",) if key in keys}
    image = write_raster(data, crs, x0, y0, cell, name=f"image{hash(data.tobytes())}.tif", **options)
    return make_scene(dem, terrain={"imagery": image.name}, **keys)


def pixel_xy(view) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates (rows, cols) of a map's pixels."""
    col, row = np.meshgrid(np.arange(view.cols), np.arange(view.rows))
    return view.grid.x(view.col0 + col * view.col_step), view.grid.y(view.row0 + row * view.row_step)


def test_map_shows_imagery_at_its_coordinates(gl, hill, write_raster, make_scene):
    """Colours are exact at cell centres and interpolated between them in linear light."""
    data = random_colors()
    scene = make_draped_scene(write_raster, make_scene, hill, data)
    view = scene.view(bounds=(X0 + 50, Y0 - 350, X0 + 350, Y0 - 50), size=(300, 300))
    albedo = geometry_buffer(scene, view).albedo
    x, y = pixel_xy(view)
    expected = bilinear(data, (Y0 - y) / CELL - 0.5, (x - X0) / CELL - 0.5)
    np.testing.assert_allclose(albedo, expected, atol=2e-4)
    cell_view = scene.view(bounds=(X0 + 125, Y0 - 150, X0 + 150, Y0 - 125), size=(25, 25))  # one cell, a metre per pixel
    np.testing.assert_allclose(geometry_buffer(scene, cell_view).albedo[12, 12], srgb_albedo(data[:, 5, 5] / 255.0), atol=1e-5)


def near_view(scene: Scene, size=(120, 90)) -> PerspectiveView:
    """Return the view ``eye``."""
    return scene.view("eye", size=size)


def eye_view(fov: float = 50.0, height: float = 40.0) -> dict:
    """Return the keys of the perspective view ``eye``, whose eye is ``height`` metres above the ground."""
    lon_lat = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform
    eye, target = lon_lat(X0 + 200, Y0 - 390), lon_lat(X0 + 200, Y0 - 200)
    return {"eye": {"kind": "perspective", "eye": [*eye, height], "target": [*target, 0], "fov": fov, "size": [120, 90]}}


def test_perspective_view_shows_imagery_at_its_points(gl, hill, write_raster, make_scene):
    data = random_colors(2)
    scene = make_draped_scene(write_raster, make_scene, hill, data, views=eye_view())
    buffer = geometry_buffer(scene, near_view(scene))
    ground = buffer.surface_kind == RELIEF
    assert ground.mean() > 0.4
    earth = buffer.position_frame_m[ground] @ buffer.frame.frame_from_earth + buffer.frame.origin_earth_m
    x, y, _ = scene.world.map_position(scene.elevation.crs, earth)
    covered = (x < X0 + SIDE * CELL - 0.01) & (y > Y0 - SIDE * CELL + 0.01)
    expected = bilinear(data, (Y0 - y) / CELL - 0.5, (x - X0) / CELL - 0.5)
    assert covered.mean() > 0.95
    np.testing.assert_allclose(buffer.albedo[ground][covered], expected[covered], atol=1e-3)


@pytest.mark.parametrize(("crs", "cell"), [("EPSG:4326", 4e-4), ("EPSG:3857", 45.0), ("EPSG:32632", 25.0)])
def test_imagery_in_another_crs_is_aligned(gl, hill, write_raster, make_scene, crs, cell):
    """The offset from PROJ's position is at most a hundredth of a cell."""
    to = Transformer.from_crs(UTM, crs, always_xy=True)
    left, bottom, right, top = to.transform_bounds(X0, Y0 - 410, X0 + 410, Y0)
    shape = int(np.ceil((top - bottom) / cell)) + 2, int(np.ceil((right - left) / cell)) + 2
    data = np.random.default_rng(3).integers(0, 256, (3, *shape)).astype(np.uint8)
    scene = make_draped_scene(write_raster, make_scene, hill, data, crs, left - cell, top + cell, cell, views=eye_view())
    view = scene.view(bounds=(X0 + 50, Y0 - 350, X0 + 350, Y0 - 50), size=(150, 150))
    for buffer, (x, y) in (
        (geometry_buffer(scene, view), pixel_xy(view)),
        (geometry_buffer(scene, near_view(scene)), (None, None)),
    ):
        ground = buffer.surface_kind == RELIEF
        if x is None:
            earth = buffer.position_frame_m @ buffer.frame.frame_from_earth + buffer.frame.origin_earth_m
            x, y, _ = scene.world.map_position(scene.elevation.crs, earth)
        image_x, image_y = to.transform(x[ground], y[ground])
        row, col = (top + cell - image_y) / cell - 0.5, (image_x - left + cell) / cell - 0.5
        np.testing.assert_allclose(buffer.albedo[ground], bilinear(data, row, col), atol=0.02)


def test_tint_shows_where_imagery_is_missing(gl, hill, write_raster, make_scene):
    """The imagery covers only the western half and has a hole. Elsewhere the albedo is NaN and the colours equal those without
    imagery.
    """
    data = random_colors(4)[:, :, :8]
    data = np.maximum(data, 1)
    data[:, 3:6, 2:5] = 0
    # Both effects apply only to ground without imagery.
    level_keys = {"views": eye_view(), "effects": {"ground_materials": "off", "ground_detail": "off"}}
    scene = make_draped_scene(write_raster, make_scene, hill, data, nodata=0, **level_keys)
    bare_scene = make_scene(hill, **level_keys)
    view = scene.view(bounds=(X0 + 10, Y0 - 390, X0 + 390, Y0 - 10), size=(190, 190))
    x, y = pixel_xy(view)
    covered = (x < X0 + 8 * CELL) & (y < Y0) & (y > Y0 - SIDE * CELL)
    row, col = (Y0 - y) / CELL, (x - X0) / CELL
    # Half a cell more on each side: interpolation needs valid cells
    hole = (row >= 2.5) & (row <= 6.5) & (col >= 1.5) & (col <= 5.5)
    albedo = geometry_buffer(scene, view).albedo
    np.testing.assert_array_equal(np.isfinite(albedo[..., 0]), covered & ~hole)
    with_imagery, without_imagery = render(scene, view), render(bare_scene, view)
    np.testing.assert_array_equal(with_imagery.color[~covered | hole], without_imagery.color[~covered | hole])
    assert (with_imagery.color != without_imagery.color).any(axis=-1)[covered & ~hole].mean() > 0.95
    with_imagery, without_imagery = render(scene, near_view(scene)), render(bare_scene, near_view(bare_scene))
    position = with_imagery.position_earth_m[with_imagery.valid]
    east = scene.world.map_position(scene.elevation.crs, position)[0] > X0 + 8 * CELL + 15
    np.testing.assert_array_equal(with_imagery.color[with_imagery.valid][east], without_imagery.color[with_imagery.valid][east])


@pytest.mark.parametrize("pixel_m", [50.0, 100.0])
def test_coarse_pixels_average_linear_light(gl, hill, write_raster, make_scene, pixel_m):
    """A black and white chequerboard finer than the pixels has half the light, not half the sRGB value."""
    board = np.where(np.indices((64, 64)).sum(axis=0) % 2, 255, 0).astype(np.uint8)
    scene = make_draped_scene(write_raster, make_scene, hill, np.stack([board] * 3), cell=6.25)
    count = int(300 / pixel_m)
    view = scene.view(bounds=(X0 + 50, Y0 - 50 - count * pixel_m, X0 + 50 + count * pixel_m, Y0 - 50), size=(count, count))
    np.testing.assert_allclose(geometry_buffer(scene, view).albedo, 0.5, atol=1e-5)


def test_imagery_colours_reach_the_picture(gl, write_raster, make_scene):
    """Gray imagery with the albedo of bare level ground gives the same picture as bare ground. Red imagery gives a red picture."""
    floor = write_raster(np.zeros((21, 21), np.float32), ENGINEERING, -105.0, 105.0, 10.0)
    gray = int(round(255 * (1.055 * FLAT_GROUND_ALBEDO ** (1 / 2.4) - 0.055)))
    pictures = {}
    for name, colour in (("bare", None), ("gray", (gray, gray, gray)), ("red", (200, 20, 20))):
        if colour is None:
            scene = make_scene(floor)
        else:
            data = np.broadcast_to(np.array(colour, np.uint8)[:, None, None], (3, 4, 4))
            scene = make_draped_scene(write_raster, make_scene, floor, data, ENGINEERING, -105.0, 105.0, 52.5)
        pictures[name] = render(scene, scene.view(bounds=(-80, -80, 80, 80), size=(32, 32))).color.astype(int)
    assert np.abs(pictures["gray"] - pictures["bare"]).max() <= 1
    red = pictures["red"]
    assert (red[..., 0] > 2 * red[..., 1]).all() and (red[..., 0] > 2 * red[..., 2]).all()


def test_sixteen_bits_are_stretched_to_their_98th_percentile(write_raster):
    data = np.full((3, 20, 20), 3000, np.uint16)
    data[:, 0, :4] = 60_000  # clouds: one in a hundred
    data[1] = 1500
    path = write_raster(data, UTM, X0, Y0, 10.0, name="sixteen.tif")
    cells = np.full((1, 1, 2), 10.0)
    np.testing.assert_allclose(Imagery(str(path)).albedo(cells, 1.0)[0, 0], [1.0, srgb_albedo(0.5), 1.0], atol=1e-5)


def test_large_imagery_is_averaged_to_max_side(write_raster, monkeypatch):
    """Cells keep their positions: 64 cells a side are read as 16."""
    monkeypatch.setattr("skugga.terrain.ground.imagery.MAX_SIDE_CELLS", 16)
    data = np.repeat(np.repeat(random_colors(5), 4, axis=1), 4, axis=2)
    path = write_raster(data, UTM, X0, Y0, CELL / 4, name="large.tif")
    image = Imagery(str(path))
    row, col = (v.ravel() for v in np.mgrid[0:SIDE, 0:SIDE])
    cells = image.cells_at(CRS.from_user_input(UTM), X0 + (col + 0.5) * CELL, Y0 - (row + 0.5) * CELL)
    np.testing.assert_allclose(cells, np.column_stack([row, col]), atol=1e-3)
    np.testing.assert_allclose(
        image.albedo(cells[:, None], 1.0)[:, 0], srgb_albedo(random_colors(5)[:, row, col].T / 255.0), atol=1e-5
    )


def test_invalid_imagery_is_rejected_in_one_line(hill, write_raster, make_scene, tmp_path):
    data = random_colors(6)
    size = {"height": SIDE, "width": SIDE, "count": 3, "dtype": "uint8", "transform": Affine(2, 0, 5, 0, -2, 9)}
    with rasterio.open(tmp_path / "nowhere.tif", "w", driver="GTiff", **size) as dataset:
        dataset.write(data)
    write_raster(data[:1], UTM, X0, Y0, CELL, name="gray.tif")
    write_raster(data.astype(np.float32), UTM, X0, Y0, CELL, name="float.tif")
    (tmp_path / "broken.tif").write_bytes(b"II*\0nothing at all")
    reasons = {
        "nowhere.tif": "no coordinate reference system", "gray.tif": "1 bands", "float.tif": "float32",
        "missing.tif": "No such file", "broken.tif": None,
    }  # fmt: skip
    for name, reason in reasons.items():
        scene = make_scene(hill, terrain={"imagery": name})
        with pytest.raises(SourceError, match=reason) as caught:
            geometry_buffer(scene, scene.view(size=(8, 8)))
        assert "\n" not in str(caught.value) and name in str(caught.value)
