"""Third-party programs before a real service: QGIS without a window, GDAL's tools, and nginx."""
