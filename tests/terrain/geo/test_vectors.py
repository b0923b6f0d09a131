"""Vector files: projection, repair, attributes, and refused files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
from pyproj import CRS, Transformer

from skugga.terrain.errors import SourceError
from skugga.terrain.geo.vectors import (
    MAX_EDGE_LENGTH_BY_IS_GEOGRAPHIC,
    attribute_names,
    numeric_attribute,
    read_features,
    vector_layer,
)
from skugga.terrain.ground.length_attributes import attribute_lengths
from tests.rasters import ENGINEERING

UTM = CRS.from_epsg(32632)
ENGINEERING_CRS = CRS.from_wkt(ENGINEERING)
BOW_TIE = [[9.0, 47.0], [9.01, 47.01], [9.01, 47.0], [9.0, 47.01], [9.0, 47.0]]


@pytest.fixture
def geojson(tmp_path: Path):
    """A function that writes geometries with properties as a GeoJSON file and returns its path."""

    def write(geometries: list, properties: list[dict] | None = None) -> str:
        rows = zip(geometries, properties or [{}] * len(geometries), strict=True)
        features = [{"type": "Feature", "properties": values, "geometry": geometry} for geometry, values in rows]
        path = tmp_path / "some.geojson"
        path.write_text(json.dumps({"type": "FeatureCollection", "features": features}), encoding="utf-8")
        return str(path)

    return write


def point(x: float, y: float) -> dict:
    """Return a GeoJSON point."""
    return {"type": "Point", "coordinates": [x, y]}


def test_geojson_has_longitude_first_and_counts_null_geometries(geojson):
    source = geojson([point(9.0, 47.0), None, point(9.5, 46.5)], [{"h": 1}, {"h": 2}, {"h": 3.5}])
    features = read_features(source, UTM, ["h"])
    expected = Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform([9.0, 9.5], [47.0, 46.5])
    np.testing.assert_allclose(shapely.get_coordinates(features.geometry).T, expected, atol=1e-6)
    assert features.omitted_count == 1
    assert numeric_attribute(features, "h").tolist() == [1.0, 3.5]


def test_multi_parts_are_kept_and_heights_are_dropped(geojson):
    features = read_features(geojson([{"type": "MultiPoint", "coordinates": [[9, 47, 400], [9.1, 47, 500]]}]), UTM)
    assert shapely.get_num_geometries(features.geometry).tolist() == [2]
    assert not shapely.has_z(features.geometry).any()


def test_polygons_are_repaired_or_dropped_without_area(geojson, tmp_path):
    broken = read_features(geojson([{"type": "Polygon", "coordinates": [BOW_TIE]}]), UTM).geometry[0]
    assert broken.is_valid
    halves = [
        shapely.Polygon([(9, 47), (9.005, 47.005), (9, 47.01)]),
        shapely.Polygon([(9.01, 47), (9.01, 47.01), (9.005, 47.005)]),
    ]
    to_utm = Transformer.from_crs("EPSG:4326", UTM, always_xy=True)
    area = sum(shapely.transform(half, lambda p: np.column_stack(to_utm.transform(*p.T))).area for half in halves)
    assert broken.area == pytest.approx(area, rel=1e-4)
    flat = [shapely.Polygon([(0, 0), (1, 1), (2, 2)]), shapely.box(0, 0, 1, 1)]
    path = tmp_path / "flat.gpkg"
    pyogrio.raw.write(path, shapely.to_wkb(flat), [], [], geometry_type="Polygon", crs="EPSG:32632")
    features = read_features(str(path), UTM)
    assert len(features.geometry) == 1 and features.omitted_count == 1


def test_long_edges_follow_their_parallel(geojson):
    long_edge_polygon = {"type": "Polygon", "coordinates": [[[8.0, 47.0], [10.0, 47.0], [10.0, 48.0], [8.0, 48.0], [8.0, 47.0]]]}
    outline = read_features(geojson([long_edge_polygon]), UTM).geometry[0]
    on_edge = shapely.Point(Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform(8.123, 47.0))
    assert outline.boundary.distance(on_edge) < 0.1
    assert MAX_EDGE_LENGTH_BY_IS_GEOGRAPHIC[True] < 2.0  # else the edge would have been a chord, 100 m off


def test_engineering_coordinates_are_not_transformed(tmp_path):
    with_crs, without_crs = tmp_path / "site.gpkg", tmp_path / "site.shp"
    for path in (with_crs, without_crs):
        pyogrio.raw.write(
            path, shapely.to_wkb(shapely.points([[3.0, 4.0]])), [], [], geometry_type="Point", crs=ENGINEERING_CRS.to_wkt()
        )
    without_crs.with_suffix(".prj").unlink()
    for path in (with_crs, without_crs):
        assert shapely.get_coordinates(read_features(str(path), ENGINEERING_CRS).geometry).tolist() == [[3.0, 4.0]]


def test_shapefile_without_prj_is_refused(tmp_path):
    path = tmp_path / "a.shp"
    pyogrio.raw.write(path, shapely.to_wkb(shapely.points([[9.0, 47.0]])), [], [], geometry_type="Point", crs="EPSG:4326")
    path.with_suffix(".prj").unlink()
    with pytest.raises(SourceError, match=r"a\.shp: no coordinate reference system \(its \.prj file is missing\)\. Use a vector"):
        read_features(str(path), UTM)


@pytest.mark.parametrize(
    ("geometries", "attributes", "message"),
    [
        ([], [], "some.geojson: no features. Use points or polygons"),
        ([None], [], "no feature with a geometry"),
        ([point(9, 47)], ["tall"], "no attribute 'tall'. Use one of name, h"),
        (
            [point(9, 470)],
            [],
            "the coordinates 9, 470 of 'WGS 84' cannot be transformed into 'WGS 84 / UTM zone 32N'. Correct the coordinates",
        ),
    ],
)
def test_missing_content_of_a_file_is_reported_in_one_line(geojson, geometries, attributes, message):
    with pytest.raises(SourceError) as caught:
        read_features(geojson(geometries, [{"name": "a", "h": 1}] * len(geometries)), UTM, attributes)
    assert message in str(caught.value) and "some.geojson" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "hello", "{}", '{"type":"FeatureCollection","features":[{"type":"Fea'])
def test_a_file_of_another_format_is_refused(tmp_path, text):
    path = tmp_path / "a.geojson"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SourceError, match="a.geojson: .*Use a vector file that GDAL reads"):
        read_features(str(path), UTM)


def test_missing_files_folders_and_rasters_are_refused(tmp_path, write_raster):
    with pytest.raises(SourceError, match="none.gpkg: no such file. Use a vector file that GDAL reads"):
        read_features(str(tmp_path / "none.gpkg"), UTM)
    for source in (tmp_path, write_raster(np.zeros((2, 2), np.float32), "EPSG:32632", 0, 4, 2)):
        with pytest.raises(SourceError, match="Use a vector file that GDAL reads"):
            read_features(str(source), UTM)


def test_degrees_are_refused_in_an_engineering_crs(geojson):
    with pytest.raises(SourceError, match="its CRS 'WGS 84' cannot be transformed into 'site'. Use a file in another CRS"):
        read_features(geojson([point(9, 47)]), ENGINEERING_CRS)


def test_numeric_attribute_parses_numbers_but_no_other_text(geojson):
    rows = [{"h": "12.5", "kind": "oak"}, {"h": None, "kind": "elm"}, {"h": " ", "kind": None}]
    features = read_features(geojson([point(9, 47)] * 3, rows), UTM, ["h", "kind"])
    np.testing.assert_array_equal(numeric_attribute(features, "h"), [12.5, np.nan, np.nan])
    with pytest.raises(SourceError, match="kind = oak at feature 1 of 3 is no number. Use numbers in the attribute 'kind'"):
        numeric_attribute(features, "kind")
    assert attribute_names(features.name) == ("h", "kind")


@pytest.mark.parametrize(
    ("values", "numbers"),
    [
        ([10, "12.5", 3.0], [10.0, 12.5, 3.0]),
        (["12", 10, None, ""], [12.0, 10.0, np.nan, np.nan]),
        ([10, ["12"], [3]], [10.0, 12.0, 3.0]),
        ([[7.5], 2], [7.5, 2.0]),
    ],
)
def test_numbers_texts_and_lists_of_one_may_be_mixed(geojson, values, numbers):
    source = geojson([point(9.0 + 0.1 * row, 47.0) for row in range(len(values))], [{"h": value} for value in values])
    features = read_features(source, UTM, ["h"])
    np.testing.assert_array_equal(numeric_attribute(features, "h"), numbers)
    np.testing.assert_array_equal(attribute_lengths(features, ["h"], {}, "heights").values_m, numbers)


@pytest.mark.parametrize("value", ["tall", [1, 2], {"a": 1}])
def test_the_feature_with_another_kind_of_value_is_named(geojson, value):
    source = geojson([point(9.0, 47.0), point(9.1, 47.0)], [{"h": 10}, {"h": value}])
    features = read_features(source, UTM, ["h"])
    with pytest.raises(SourceError, match="at feature 2 of 2 is no number"):
        numeric_attribute(features, "h")
    lengths = attribute_lengths(features, ["h"], {}, "heights")
    assert lengths.values_m[0] == 10.0 and "at feature 2 of 2: ignored, not a length" in lengths.warnings[0]


def test_booleans_become_texts_and_are_no_numbers(geojson):
    features = read_features(geojson([point(9, 47)] * 3, [{"h": True}, {"h": False}, {"h": None}]), UTM, ["h"])
    assert features.attributes["h"].tolist() == ["true", "false", None]
    with pytest.raises(SourceError, match="h = true at feature 1 of 3 is no number"):
        numeric_attribute(features, "h")


# -- text tables


@pytest.fixture
def table(tmp_path):
    """Return a function that writes lines of text to a file."""

    def write(*lines: str, name: str = "trees.csv") -> str:
        (tmp_path / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
        return str(tmp_path / name)

    return write


@pytest.mark.parametrize("header", ["lon,lat,h", "H;Latitude;Longitude", "long,h,LAT"])
def test_table_points_come_from_longitude_and_latitude(table, header):
    separator = ";" if ";" in header else ","
    values = {"h": "8 m", "la": "47.0", "lo": "9.0"}
    source = table(header, separator.join(values[name.lower()[:2]] for name in header.split(separator)))
    features = read_features(source, UTM, [name for name in header.split(separator) if name.lower() == "h"])
    expected = Transformer.from_crs("EPSG:4326", UTM, always_xy=True).transform(9.0, 47.0)
    np.testing.assert_allclose(shapely.get_coordinates(features.geometry), [expected], atol=1e-6)
    assert [values.tolist() for values in features.attributes.values()] == [["8 m"]]


def test_table_rows_without_coordinates_are_counted(table):
    features = read_features(table("lon,lat", "9,47", ",47", "east,47"), UTM)
    assert len(features.geometry) == 1 and features.omitted_count == 2


def test_table_points_in_metres_need_an_engineering_crs(table):
    source = table("x,y", "3,4")
    assert shapely.get_coordinates(read_features(source, ENGINEERING_CRS).geometry).tolist() == [[3.0, 4.0]]
    with pytest.raises(SourceError, match=r"trees.csv: no coordinate reference system\. Use columns lon and lat in degrees, or"):
        read_features(source, UTM)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["a,b", "9,47"], "no feature with a geometry. Use columns lon and lat"),
        (["lon,lat"], "no features. Use columns"),
        (["WKT,lon,lat", '"POINT (5e5 5.2e6)",9,47'], "no coordinate reference system. Use columns lon and lat"),
    ],
)
def test_tables_without_places_name_the_columns(table, lines, message):
    with pytest.raises(SourceError) as caught:
        read_features(table(*lines), UTM)
    assert f"trees.csv: {message}" in str(caught.value)


# -- layers


@pytest.fixture
def layered_geopackage(tmp_path):
    """Return a GeoPackage with a table, a layer without features, then points, parcels and buildings."""
    path = tmp_path / "town.gpkg"
    square = [shapely.box(5e5, 5.2e6, 500010, 5200010)]
    layers = {
        "empty": ([], "Polygon", {}), "wells": ([shapely.Point(5e5, 5.2e6)], "Point", {}),
        "parcels": (square, "Polygon", {"owner": ["a"]}), "buildings": (square, "Polygon", {"Height": [7.0]}),
    }  # fmt: skip
    pyogrio.raw.write(path, None, [np.array(["x"], object)], ["note"], geometry_type=None, driver="GPKG", layer="notes")
    for name, (geometry, kind, fields) in layers.items():
        wkb, values = shapely.to_wkb(np.array(geometry, object)), [np.array(value) for value in fields.values()]
        pyogrio.raw.write(path, wkb, values, list(fields), geometry_type=kind, crs="EPSG:32632", layer=name, append=True)
    return str(path)


def test_vector_layer_is_the_first_with_matching_geometries(layered_geopackage):
    assert (vector_layer(layered_geopackage, (0,)).name, vector_layer(layered_geopackage, (0, 2)).name) == ("wells", "wells")
    parcels = vector_layer(layered_geopackage, (2,))
    assert (parcels.name, parcels.other_layers) == ("parcels", ("buildings",))
    assert parcels.notes == ("layer 'parcels', not buildings (the key layer selects another one)",)
    buildings = vector_layer(layered_geopackage, (2,), accepts_attributes=lambda names: "Height" in names)
    assert (buildings.name, buildings.other_layers) == ("buildings", ("parcels",))
    assert numeric_attribute(read_features(layered_geopackage, UTM, ["Height"], layer=buildings), "Height").tolist() == [7.0]
    with pytest.raises(SourceError, match="town.gpkg: no features. Use points or polygons"):
        read_features(layered_geopackage, UTM, layer=vector_layer(layered_geopackage, (2,), "empty"))


def test_vector_layer_takes_a_name_and_lists_the_layers(layered_geopackage, geojson):
    assert vector_layer(layered_geopackage, (0,), "buildings").name == "buildings"
    with pytest.raises(SourceError, match="town.gpkg: no layer 'roofs'. Use one of empty, wells, parcels, buildings, notes"):
        vector_layer(layered_geopackage, (2,), "roofs")
    assert vector_layer(geojson([point(9, 47)]), (2,)).name is None
    with pytest.raises(SourceError, match="no such file"):
        vector_layer("none.gpkg", (2,))


def test_vector_layer_falls_back_to_other_geometries(layered_geopackage):
    """The reader can then report which geometries the file has."""
    assert vector_layer(layered_geopackage, (1,)).name == "wells"


GPX_TRACK = """<?xml version="1.0"?><gpx version="1.1" creator="x" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="47.0" lon="9.0"><time>2024-10-21T06:00:00Z</time></trkpt>
<trkpt lat="47.1" lon="9.1"><time>2024-10-21T07:30:00Z</time></trkpt></trkseg></trk></gpx>"""


def test_gpx_tracks_are_read_although_waypoints_are_empty(tmp_path):
    path = tmp_path / "tour.gpx"
    path.write_text(GPX_TRACK, encoding="utf-8")
    lines = vector_layer(str(path), (1,))
    assert lines.name == "tracks"
    assert shapely.get_num_coordinates(read_features(str(path), CRS.from_epsg(4326), layer=lines).geometry).tolist() == [2]
    points = vector_layer(str(path), (0,))
    times = read_features(str(path), UTM, ["time"], layer=points).attributes["time"]
    assert points.name == "track_points" and times.tolist() == ["2024-10-21T06:00:00Z", "2024-10-21T07:30:00Z"]


# -- one bad feature among many

SQUARE = [[9.0, 47.0], [9.01, 47.0], [9.01, 47.01], [9.0, 47.0]]


@pytest.mark.parametrize(
    ("bad", "expected_text"),
    [
        (
            [SQUARE[:2]],
            "feature 3 of 4 .fid 17.: Points of LinearRing do not form a closed linestring. Use undamaged geometries",
        ),
        ([SQUARE[:3]], "feature 3 of 4 .fid 17.: Points of LinearRing do not form a closed"),
        ([[[9.0, 47.0], [9.0, 470.0], *SQUARE[2:]]], "feature 3 of 4 .fid 17.: the coordinates 9, 470 of 'WGS 84' cannot"),
        ([SQUARE, [[x + 1.0, y] for x, y in SQUARE]], "feature 3 of 4 .fid 17.: a hole outside of its polygon, at 10, 47[.] Keep"),
    ],
)
def test_one_bad_feature_among_many_is_named(geojson, bad, expected_text):
    source = geojson([{"type": "Polygon", "coordinates": rings} for rings in ([SQUARE], [SQUARE], bad, [SQUARE])])
    text = json.loads(Path(source).read_text())
    for number, feature in enumerate(text["features"]):
        feature["id"] = 15 + number
    Path(source).write_text(json.dumps(text), encoding="utf-8")
    with pytest.raises(SourceError, match=expected_text) as caught:
        read_features(source, UTM)
    assert "\n" not in str(caught.value)


def test_a_hole_inside_its_polygon_is_kept(geojson):
    hole = [[9.006, 47.002], [9.008, 47.002], [9.008, 47.004], [9.006, 47.002]]
    (polygon,) = read_features(geojson([{"type": "Polygon", "coordinates": [SQUARE, hole]}]), UTM).geometry
    assert len(polygon.interiors) == 1


def test_features_are_numbered_as_in_the_file(geojson):
    features = read_features(geojson([None, point(9, 47), None, point(9.1, 47)]), UTM)
    assert features.number_in_layer.tolist() == [2, 4] and features.label(1) == "feature 4 of 4" and features.omitted_count == 2
    assert features[np.array([1, 1])].omitted_count == 3
