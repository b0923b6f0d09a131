"""OGC services, WMS and WMTS: requests, XML documents, and a layer file for QGIS."""
