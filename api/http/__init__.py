"""The HTTP service, with a folder for each kind of resource.

The modules beside the folders parse request parameters, times and numbers, and build response headers, problem documents and
OpenAPI parts.
"""
