"""Check that this machine has the system libraries that Skugga needs. Print one line, and exit with status 1 if one is missing.

The check imports the compiled packages and creates an OpenGL context like the renderer, which also shows that the driver works.
"""

import importlib
import sys

COMPILED_PACKAGES = ("numba", "numpy", "pyproj", "rasterio", "scipy", "PIL.Image")
"""Modules that load system libraries on import."""


def main() -> int:
    """Print one line with the result, and return the exit status: 0, or 1 if a library is missing."""
    try:
        for name in COMPILED_PACKAGES:
            importlib.import_module(name)
        from skugga.terrain.gl.egl_devices import open_context

        context, _ = open_context()
    except Exception as error:  # the caller needs any error on one line
        print(f"skugga: {type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    major, minor = divmod(context.version_code // 10, 10)
    print(f"skugga: OpenGL {major}.{minor}, {context.info['GL_RENDERER']}")
    context.release()
    return 0


if __name__ == "__main__":
    sys.exit(main())
