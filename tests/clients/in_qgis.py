"""Draw a service in QGIS, run by the Python that QGIS is installed for: ``python3 in_qgis.py ADDRESS LEVEL FOLDER < PLAN``.

The plan (JSON) has ``bounds`` in EPSG:3857, ``degrees`` in EPSG:4326, ``deep`` (finer than any tile), a ``side`` in pixels,
``zooms`` (first and last) and ``times`` by name, each begin and end. Pictures go to the folder, all other findings to
``report.json`` there.
"""

from __future__ import annotations

import json
import os
import sys
import urllib.request
from pathlib import Path

from qgis.core import (
    Qgis,
    QgsApplication,
    QgsCoordinateReferenceSystem,
    QgsDateTimeRange,
    QgsLayerDefinition,
    QgsLayerItem,
    QgsMapRendererParallelJob,
    QgsMapSettings,
    QgsNetworkAccessManager,
    QgsProject,
    QgsRaster,
    QgsRasterLayer,
    QgsRectangle,
    QgsSettings,
)
from qgis.PyQt.QtCore import QDateTime, QEventLoop, QSize, Qt, QTimer
from qgis.PyQt.QtGui import QColor

LEGEND_MS = 60_000

address, level, folder = sys.argv[1], sys.argv[2], Path(sys.argv[3]).resolve()
plan = json.load(sys.stdin)
bounds, degrees, deep = (QgsRectangle(*plan[name]) for name in ("bounds", "degrees", "deep"))
side = plan["side"]

QgsApplication.setPrefixPath("/usr", True)
application = QgsApplication([], False, str(folder / "profile"))
application.initQgis()

report = {"version": Qgis.QGIS_VERSION, "layers": {}, "requests": [], "log": [], "identified": {}, "legends": {}}
QgsApplication.messageLog().messageReceived.connect(lambda text, tag, _: report["log"].append(f"{tag}: {text}"))
QgsNetworkAccessManager.setRequestPreprocessor(lambda request: report["requests"].append(request.url().toString()))

kept_references = []
"""References to objects that QGIS would free otherwise."""


def browser_sources(name: str, url: str) -> list[str]:
    """Return the sources of the layers that QGIS's browser lists under a new connection."""
    QgsSettings().setValue(f"qgis/connections-wms/{name}/url", url)
    providers = QgsApplication.dataItemProviderRegistry().providers()
    root = next(item for item in providers if item.name() == "WMS").createDataItem("", None)
    root.populate(True)
    return layer_sources(next(item for item in root.children() if item.name() == name), root)


def layer_sources(item: object, *above: object) -> list[str]:
    """Return the sources of all layers below an item of the browser. ``above`` keeps its parents alive."""
    item.populate(True)
    children = item.children()
    kept_references.append((item, children, above))
    own_sources = [item.uri()] if isinstance(item, QgsLayerItem) else []
    return own_sources + [source for child in children for source in layer_sources(child)]


def record_layer(name: str, layer: QgsRasterLayer) -> QgsRasterLayer:
    """Record a layer under a name with QGIS's facts of it, and return it."""
    kept_references.append(layer)
    times = layer.dataProvider().temporalCapabilities() if layer.isValid() else None
    span = times.availableTemporalRange() if times is not None and times.hasTemporalCapabilities() else None
    report["layers"][name] = {
        "valid": layer.isValid(),
        "crs": layer.crs().authid(),
        "times": span and [edge.toUTC().toString(Qt.ISODate) for edge in (span.begin(), span.end())],
    }
    return layer


def draw_layer(
    name: str, layer: QgsRasterLayer, extent: QgsRectangle = bounds, crs: str = "EPSG:3857", times: list | None = None
) -> None:
    """Draw a layer as the map canvas does, in a range of times as the temporal controller sets it."""
    settings = QgsMapSettings()
    settings.setLayers([layer])
    settings.setDestinationCrs(QgsCoordinateReferenceSystem(crs))
    settings.setExtent(extent)
    settings.setOutputSize(QSize(side, side))
    settings.setBackgroundColor(QColor(0, 0, 0, 0))
    if times is not None:
        settings.setIsTemporal(True)
        settings.setTemporalRange(QgsDateTimeRange(*(QDateTime.fromString(instant, Qt.ISODate) for instant in times)))
    job = QgsMapRendererParallelJob(settings)
    job.start()
    job.waitForFinished()
    job.renderedImage().save(str(folder / f"{name}.png"))


def record_legend(name: str, layer: QgsRasterLayer) -> None:
    """Record the sizes of the legend in the layer tree; ``None`` where QGIS requests none."""
    settings = QgsMapSettings()
    settings.setExtent(bounds)
    settings.setOutputSize(QSize(side, side))
    fetcher = layer.dataProvider().getLegendGraphicFetcher(settings)
    report["legends"][name] = None
    if fetcher is None:
        return
    loop, images = QEventLoop(), []
    fetcher.finish.connect(lambda image: (images.append(image), loop.quit()))
    fetcher.error.connect(lambda text: (report["log"].append(f"legend: {text}"), loop.quit()))
    QTimer.singleShot(LEGEND_MS, loop.quit)
    fetcher.start()
    if not images:
        loop.exec_()
    report["legends"][name] = [[image.width(), image.height()] for image in images]


def draw_wms_layers() -> None:
    """Draw all layers of the WMS, with their legends."""
    layers = {}
    for source in browser_sources("wms", f"{address}/levels/{level}/wms"):
        name = source.partition(f"layers={level}:")[2].partition("&")[0]
        layers[name] = record_layer(f"wms-{name}", QgsRasterLayer(source, name, "wms"))
        draw_layer(f"wms-{name}", layers[name])
        record_legend(name, layers[name])
        if name == "color":
            in_degrees = record_layer("wms-degrees", QgsRasterLayer(source.replace("crs=EPSG:3857", "crs=EPSG:4326"), name, "wms"))
            draw_layer("wms-degrees", in_degrees, degrees, "EPSG:4326")
    for name, times in plan["times"].items():
        draw_layer(f"wms-{name}", layers["color"], times=times)
    for name, format in (("html", QgsRaster.IdentifyFormatHtml), ("text", QgsRaster.IdentifyFormatText)):
        result = layers["color"].dataProvider().identify(bounds.center(), format, bounds, side, side)
        report["identified"][name] = result.results().get(0) if result.isValid() else None


def draw_wmts_layers() -> None:
    """Draw a layer of the WMTS."""
    every = browser_sources("wmts", f"{address}/levels/{level}/WMTSCapabilities.xml")
    required_parts = (f"layers={level}:color&", "tileMatrixSet=WebMercatorQuad", "format=image/png")
    matching_sources = [source_uri for source_uri in every if all(part in source_uri for part in required_parts)]
    source = next(
        source_uri for source_uri in matching_sources if "/" not in source_uri.partition("tileDimensions=")[2].partition("&")[0]
    )
    layer = record_layer("wmts", QgsRasterLayer(source, "color", "wms"))
    draw_layer("wmts", layer)
    draw_layer("wmts-deep", layer, deep)
    span = next(source_uri for source_uri in matching_sources if source_uri is not source and "PT" in source_uri)
    draw_layer("wmts-span", record_layer("wmts-span", QgsRasterLayer(span, "color", "wms")))


def draw_xyz_layer() -> None:
    """Draw the tiles by their URL template, also beyond the last zoom."""
    template = f"{address}/levels/{level}/tiles/WebMercatorQuad/{{z}}/{{x}}/{{y}}.png"
    layer = record_layer(
        "xyz", QgsRasterLayer(f"type=xyz&zmin={plan['zooms'][0]}&zmax={plan['zooms'][1]}&url={template}", "xyz", "wms")
    )
    draw_layer("xyz", layer)
    draw_layer("xyz-deep", layer, deep)


def draw_layer_definition() -> None:
    """Draw the layers of the level's QGIS layer definition file."""
    path = folder / f"{level}.qlr"
    urllib.request.urlretrieve(f"{address}/levels/{level}.qlr", path)
    project = QgsProject.instance()
    loaded, words = QgsLayerDefinition.loadLayerDefinition(str(path), project, project.layerTreeRoot())
    assert loaded, words
    for node in project.layerTreeRoot().findLayers():
        name = f"qlr-{node.name().rpartition(' ')[2]}"
        draw_layer(name, record_layer(name, node.layer()))


for part in (draw_wms_layers, draw_wmts_layers, draw_xyz_layer, draw_layer_definition):
    part()
(folder / "report.json").write_text(json.dumps(report, indent=1))
os._exit(0)  # QGIS's regular exit frees objects that Python still holds, and crashes
