"""Says whether this machine has the system libraries that Skugga needs; exit status 1 and one line if not.

The check is the use itself: the compiled packages are imported and an OpenGL context is made the way the renderer
makes it, since the presence of a library file says little about whether a driver answers.
"""

import importlib
import sys
from typing import Any

import moderngl

COMPILED = ("numba", "numpy", "pyproj", "rasterio", "scipy", "PIL.Image")


def main() -> int:
    try:
        for name in COMPILED:
            importlib.import_module(name)
        # The names are given because finding them needs ldconfig or a compiler, which slim machines lack.
        settings: dict[str, Any] = {"backend": "egl", "libgl": "libGL.so.1", "libegl": "libEGL.so.1"}
        context = moderngl.create_context(standalone=True, **settings)
    except Exception as error:  # whatever is wrong, the caller needs it as one line
        print(f"skugga: {type(error).__name__}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    major, minor = divmod(context.version_code // 10, 10)
    print(f"skugga: OpenGL {major}.{minor}, {context.info['GL_RENDERER']}")
    context.release()
    return 0


if __name__ == "__main__":
    sys.exit(main())
