"""Open files in QGIS, run by the Python that QGIS is installed for: ``python3 files_in_qgis.py FOLDER < PLAN``.

The plan (JSON) has ``rasters`` and ``vectors``, files by name, and a ``point`` in the CRS of the rasters. What QGIS finds goes to
``report.json`` in the folder.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

from qgis.core import QgsApplication, QgsPointXY, QgsRaster, QgsRasterLayer, QgsVectorLayer

folder, plan = Path(sys.argv[1]).resolve(), json.load(sys.stdin)

QgsApplication.setPrefixPath("/usr", True)
application = QgsApplication([], False, str(folder / "profile"))
application.initQgis()

report = {"rasters": {}, "vectors": {}, "log": []}
QgsApplication.messageLog().messageReceived.connect(lambda text, tag, _: report["log"].append(f"{tag}: {text}"))

for name, path in plan["rasters"].items():
    layer = QgsRasterLayer(path, name, "gdal")
    provider = layer.dataProvider()
    bands = range(1, layer.bandCount() + 1)
    found = provider.identify(QgsPointXY(*plan["point"]), QgsRaster.IdentifyFormatValue)
    report["rasters"][name] = {
        "valid": layer.isValid(),
        "crs": layer.crs().authid(),
        "size": [layer.height(), layer.width()],
        "bands": [layer.bandName(band) for band in bands],
        "has_nodata": [provider.sourceHasNoDataValue(band) for band in bands],
        "values": [found.results()[band] for band in bands],
    }

for name, path in plan["vectors"].items():
    layer = QgsVectorLayer(path, name, "ogr")
    report["vectors"][name] = {
        "valid": layer.isValid(),
        "crs": layer.crs().authid(),
        "fields": [field.name() for field in layer.fields()],
        "rows": [
            {"area": feature.geometry().area(), **{key: feature[key] for key in ("feature", "cells", "kwh_m2", "kwh")}}
            for feature in layer.getFeatures()
        ],
    }

(folder / "report.json").write_text(json.dumps(report, indent=1, default=lambda value: None))  # QGIS's NULL is an object of its own
os._exit(0)  # QGIS's regular exit frees objects that Python still holds, and crashes
