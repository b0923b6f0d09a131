"""OGC's services, WMS and WMTS: what they are asked, their documents in XML, a layer file for QGIS."""
