"""Says whether this machine has the system libraries that Skugga needs; exit status 1 and one line if not.

The check is the use itself: the compiled packages are imported and an OpenGL context is made the way the renderer
makes it, since the presence of a library file says little about whether a driver answers.
"""

import importlib
import sys

COMPILED = ("numba", "numpy", "pyproj", "rasterio", "scipy", "PIL.Image")


def main() -> int:
    try:
        for name in COMPILED:
            importlib.import_module(name)
        from skugga.terrain.gl.egl_devices import open_context

        context, _ = open_context()
    except Exception as error:  # whatever is wrong, the caller needs it as one line
        print(f"skugga: {type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    major, minor = divmod(context.version_code // 10, 10)
    print(f"skugga: OpenGL {major}.{minor}, {context.info['GL_RENDERER']}")
    context.release()
    return 0


if __name__ == "__main__":
    sys.exit(main())
