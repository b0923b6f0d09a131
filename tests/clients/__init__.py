"""Programs that read map services and know nothing of Skugga, before a real service: QGIS without a window, and GDAL's tools."""
