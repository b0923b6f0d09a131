"""Made terrains and villages for the evaluation of the selector: deterministic rasters, houses and woods of many shapes.

Each terrain is a function of the position in metres and a random generator. Villages have houses as footprints with heights, and
woods as polygons with a density. All lie in EPSG:32633 around the same point, near 15 degrees east and 47 degrees north.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine
from pyproj import Transformer

CRS = "EPSG:32633"
CENTRE_M = 500_000.0, 5_200_000.0
"""Easting and northing of the centre of every terrain, metres."""

House = tuple[float, float, float, float, float, float]
"""Metres of its centre to the east and north of the terrain's centre; length, width and height in metres; direction of its length,
degrees anticlockwise from east."""

Wood = tuple[float, float, float, float, float]
"""Metres of its centre to the east and north of the terrain's centre; length (eastwards) and width in metres; trees per hectare."""


@dataclass(frozen=True)
class Site:
    """A made terrain.

    Attributes
    ----------
    cells : int
        Rows and columns of the raster.
    cell_m : float
        Side of a cell in metres.
    height_m : Callable
        Heights in metres of a position: arrays of metres east and north of the centre, and a random generator.
    altitudes_deg : tuple of float
        Altitude of the sun in degrees in the map and in the perspective view: low enough for cast shadow.
    houses, woods : Callable or None
        Houses and woods by a random generator.
    is_seen_from_afar : bool
        Whether both views show the terrain in perspective from afar: woods whose trees have a few pixels.
    """

    cells: int
    cell_m: float
    altitudes_deg: tuple[float, float]
    height_m: Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]
    houses: Callable[[np.random.Generator], list[House]] | None = None
    woods: Callable[[np.random.Generator], list[Wood]] | None = None
    is_seen_from_afar: bool = False


def write_site(site: Site, folder: Path) -> dict[str, Any]:
    """Write the files of a made terrain into ``folder``, and return the keys of a level over them."""
    seed = list(SITES.values()).index(site)
    half_m = site.cells * site.cell_m / 2
    offsets_m = (np.arange(site.cells) + 0.5) * site.cell_m - half_m
    east_m, north_m = np.meshgrid(offsets_m, -offsets_m)
    height_m = site.height_m(east_m, north_m, np.random.default_rng(seed)).astype(np.float32)
    transform = Affine(site.cell_m, 0, CENTRE_M[0] - half_m, 0, -site.cell_m, CENTRE_M[1] + half_m)
    with rasterio.open(
        folder / "site.tif", "w", driver="GTiff", width=site.cells, height=site.cells, count=1, dtype="float32", crs=CRS,
        transform=transform,
    ) as dataset:  # fmt: skip
        dataset.write(height_m, 1)
    keys: dict[str, Any] = {"terrain": {"source": "site.tif"}}
    if site.houses is not None:
        features = [
            _feature(_rectangle(*house[:4], house[5]), height_m=round(house[4], 2))
            for house in site.houses(np.random.default_rng(seed + 100))
        ]
        _write_features(folder / "houses.geojson", features)
        keys["meshes"] = [{"source": "houses.geojson", "roof": "auto"}]
    if site.woods is not None:
        keys["forest"] = []
        for number, (east, north, length, width, per_ha) in enumerate(site.woods(np.random.default_rng(seed + 200))):
            _write_features(folder / f"wood_{number}.geojson", [_feature(_rectangle(east, north, length, width, 0.0))])
            wood = {"source": f"wood_{number}.geojson", "density": per_ha, "height": [6, 18], "crown": [4, 8], "seed": number}
            keys["forest"].append(wood)
    return keys


def _rectangle(east_m: float, north_m: float, length_m: float, width_m: float, angle_deg: float) -> list[tuple[float, float]]:
    """Return the closed ring of a rectangle in degrees of longitude and latitude.

    Its centre is ``east_m`` and ``north_m`` from that of the site. Its length points ``angle_deg`` anticlockwise from east.
    """
    to_lon_lat = Transformer.from_crs(CRS, "OGC:CRS84", always_xy=True)
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    ring = []
    for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)):
        u, v = a * length_m / 2, b * width_m / 2
        x, y = CENTRE_M[0] + east_m + cosine * u - sine * v, CENTRE_M[1] + north_m + sine * u + cosine * v
        ring.append(to_lon_lat.transform(x, y))
    return ring


def _feature(ring: list[tuple[float, float]], **properties: float) -> dict[str, Any]:
    """Return a GeoJSON feature of a polygon. ``ring`` is its closed outline, (longitude, latitude) in degrees."""
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Polygon", "coordinates": [ring]}}


def _write_features(path: Path, features: list[dict[str, Any]]) -> None:
    """Write GeoJSON features as a collection."""
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}), encoding="utf-8")


def fractal_noise(shape: tuple[int, int], exponent: float, random: np.random.Generator) -> np.ndarray:
    """Return noise (rows, cols) with mean 0 and standard deviation 1 whose amplitudes are proportional to frequency ** -exponent.

    Larger exponents are smoother. (D. Saupe, Algorithms for random fractals, 1988: spectral synthesis.)
    """
    row, col = np.meshgrid(np.fft.fftfreq(shape[0]), np.fft.rfftfreq(shape[1]), indexing="ij")
    frequency = np.hypot(row, col)
    frequency[0, 0] = np.inf
    spectrum = frequency**-exponent * np.exp(2j * np.pi * random.random(frequency.shape))
    noise = np.fft.irfft2(spectrum, shape)
    return (noise - noise.mean()) / noise.std()


def _fractal(exponent: float, relief_m: float) -> Callable[..., np.ndarray]:
    """Return a function ``Site.height_m`` of fractal mountains around 1000 m. ``relief_m`` is the standard deviation of heights."""
    return lambda east, north, random: 1000 + relief_m * fractal_noise(east.shape, exponent, random)


def _ridges(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Sharp ridges and wide valleys: the absolute value of a smooth noise, upside down."""
    return 2000 - 600 * np.abs(fractal_noise(east.shape, 1.9, random)) + 15 * fractal_noise(east.shape, 1.3, random)


def _craters(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Bowls with raised rims of many sizes on a plain."""
    height = 3 * fractal_noise(east.shape, 1.6, random)
    span = np.ptp(east)
    for _ in range(60):
        radius = span * 0.12 * random.random() ** 3 + span * 0.01
        x, y = span * (random.random(2) - 0.5)
        distance = np.hypot(east - x, north - y) / radius
        height += np.where(distance < 1, 0.3 * radius * (distance**2 - 0.8), 0.06 * radius * np.exp(-4 * (distance - 1)))
    return height


def _dunes(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Asymmetric waves: gentle slopes to windward, and slip faces of 33 degrees to leeward."""
    phase = (east + 0.25 * north) / 400 + 0.6 * fractal_noise(east.shape, 2.2, random)
    saw = phase % 1.0
    return 60 * np.where(saw < 0.78, saw / 0.78, (1 - saw) / 0.22)


def _canyon(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A plateau with a winding canyon whose walls are terraces."""
    distance = np.abs(north - 900 * np.sin(east / 1500)) + 150 * np.abs(fractal_noise(east.shape, 1.8, random))
    depth = 700 * np.exp(-((distance / 900) ** 2))
    return 1800 - np.round(depth / 90) * 90 + 2 * fractal_noise(east.shape, 1.4, random)


def _volcano(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A volcanic cone with a crater at its top."""
    distance = np.hypot(east, north)
    cone = 2400 * np.exp(-distance / 3500) - 700 * np.exp(-((distance / 500) ** 2))
    return 300 + cone + 25 * fractal_noise(east.shape, 1.7, random)


def _towers(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A plain with steep towers of rock (cone karst)."""
    height = 2 * fractal_noise(east.shape, 1.5, random)
    span = np.ptp(east)
    for _ in range(90):
        x, y = span * (random.random(2) - 0.5)
        radius = 60 + 90 * random.random()
        height = np.maximum(height, (120 + 160 * random.random()) * (1 - (np.hypot(east - x, north - y) / radius) ** 4))
    return height


def _quarry(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A pit with vertical benches of 12 m in a gentle hill."""
    distance = np.hypot(east, 1.3 * north)
    hill = 40 * np.exp(-((distance / 400) ** 2)) + 0.3 * fractal_noise(east.shape, 1.2, random)
    return hill - 12 * np.clip(np.ceil((220 - distance) / 30), 0, 6)


def _valley(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A valley with a flat floor and steep sides, as glaciers leave it."""
    across = np.abs(east + 400 * np.sin(north / 2500)) / 1200
    return 500 + 1400 * np.clip(across**4 / (1 + across**4), 0, 1) + 60 * fractal_noise(east.shape, 1.8, random)


def _plain(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A level plain with bumps of less than a metre."""
    return 400 + 0.4 * fractal_noise(east.shape, 1.8, random)


def _slope(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """A slope that rises by one metre in four towards the north."""
    return 600 + 0.25 * north + 3 * fractal_noise(east.shape, 1.9, random)


def _hollow(east: np.ndarray, north: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """An elliptic bowl, steeper from west to east than from south to north."""
    return 500 + (east**2 + 0.4 * north**2) / 900 + 1.5 * fractal_noise(east.shape, 1.8, random)


def _scattered(count: int, span_m: float, height_m: tuple[float, float]) -> Callable[[np.random.Generator], list[House]]:
    """Return a function ``Site.houses`` of ``count`` houses at random places in a square with sides of ``span_m``.

    ``height_m`` has the lowest and the highest height.
    """

    def houses(random: np.random.Generator) -> list[House]:
        low, high = height_m
        return [
            (*span_m * (random.random(2) - 0.5), 8 + 8 * random.random(), 6 + 5 * random.random(),
             low + (high - low) * random.random(), 180 * random.random())
            for _ in range(count)
        ]  # fmt: skip

    return houses


def _blocks(count: int, pitch_m: float, side_m: float, height_m: tuple[float, float]) -> Callable[..., list[House]]:
    """Return a function ``Site.houses`` of ``count`` x ``count`` houses on a grid of streets.

    ``pitch_m`` is the distance between centres, ``side_m`` the length of a house. ``height_m`` has the lowest and the highest
    height.
    """

    def houses(random: np.random.Generator) -> list[House]:
        low, high = height_m
        return [
            (pitch_m * (col - (count - 1) / 2), pitch_m * (row - (count - 1) / 2), side_m, side_m * (0.6 + 0.4 * random.random()),
             low + (high - low) * random.random() ** 2, 12.0)
            for row in range(count) for col in range(count)
        ]  # fmt: skip

    return houses


def _woods_at(*woods: Wood) -> Callable[[np.random.Generator], list[Wood]]:
    """Return a function ``Site.woods`` that returns these woods, whatever its generator."""
    return lambda random: list(woods)


SITES: dict[str, Site] = {
    "smooth hills": Site(512, 30.0, (6, 9), _fractal(2.2, 260.0)),
    "rough mountains": Site(512, 30.0, (30, 9), _fractal(1.7, 420.0)),
    "lidar ground": Site(512, 1.0, (14, 7), _fractal(1.6, 2.5)),
    "coarse ranges": Site(400, 250.0, (8, 13), _fractal(1.8, 900.0)),
    "ridges": Site(512, 30.0, (22, 35), _ridges),
    "craters": Site(512, 10.0, (6, 9), _craters),
    "dunes": Site(512, 5.0, (24, 16), _dunes),
    "canyon": Site(512, 10.0, (14, 38), _canyon),
    "volcano": Site(512, 30.0, (17, 11), _volcano),
    "karst": Site(512, 5.0, (42, 9), _towers),
    "quarry": Site(512, 1.0, (6, 45), _quarry),
    "glacial valley": Site(512, 20.0, (34, 18), _valley),
    "village on a plain": Site(300, 1.0, (14, 27), _plain, _scattered(60, 240.0, (4.0, 9.0))),
    "village on a slope": Site(300, 1.0, (52, 9), _slope, _scattered(45, 240.0, (4.0, 11.0)), _woods_at((-90, 60, 60, 90, 120))),
    "town": Site(400, 1.0, (22, 45), _plain, _blocks(9, 36.0, 22.0, (8.0, 22.0))),
    "high-rises": Site(400, 1.0, (6, 18), _plain, _blocks(5, 70.0, 26.0, (15.0, 90.0))),
    "hamlet in a wood": Site(
        300, 1.0, (34, 27), _hollow, _scattered(14, 90.0, (4.0, 8.0)), _woods_at((0, 100, 260, 70, 160), (0, -100, 260, 70, 160))
    ),
    "suburb": Site(360, 1.0, (14, 9), _plain, _blocks(10, 30.0, 12.0, (5.0, 9.0)), _woods_at((0, 0, 300, 300, 30))),
    "park": Site(300, 1.0, (52, 40), _hollow, None, _woods_at((-60, 40, 120, 120, 50), (80, -60, 90, 120, 25))),
    "copses": Site(
        400, 1.0, (22, 18), _slope, None, _woods_at((-110, 90, 70, 90, 200), (90, 60, 60, 60, 200), (20, -110, 140, 50, 200))
    ),
    "wooded hills": Site(400, 2.5, (14, 24), _fractal(2.2, 40.0), None, _woods_at((0, 0, 960, 960, 220)), is_seen_from_afar=True),
    "wooded mountains": Site(
        400, 2.5, (20, 28), _fractal(2.0, 90.0), None, _woods_at((0, 0, 960, 960, 200)), is_seen_from_afar=True
    ),
}
"""Made terrains by name."""
