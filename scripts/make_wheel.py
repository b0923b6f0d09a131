"""Build a wheel with the viewer and with all loops compiled for x86-64-v3: ``python scripts/make_wheel.py [FOLDER]`` (dist).

The loops are those of this Python and of the installed numba and NumPy. The wheel works with others, too, and compiles there.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from terrain.compiling.ahead import PRODUCTS
from terrain.compiling.bundle import FOLDER, TARGET, VERSIONS, installed_versions

ROOT = Path(__file__).resolve().parents[1]


def main(folder: Path) -> None:
    """Compile, build, and remove what was compiled: a clone compiles for its own processor."""
    environment = {**os.environ, **TARGET, "NUMBA_CACHE_DIR": str(FOLDER)}
    shutil.rmtree(FOLDER, ignore_errors=True)
    shutil.rmtree(ROOT / "build", ignore_errors=True)  # what an earlier build has left would get into the wheel
    try:
        cores = len(os.sched_getaffinity(0))
        farm = [sys.executable, "-m", "terrain.compiling.farm", f"--processes={cores}", *PRODUCTS]
        subprocess.run(farm, env=environment, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)
        for lock in FOLDER.glob(".*"):
            lock.unlink()
        (FOLDER / VERSIONS).write_text(json.dumps(installed_versions(), indent=1) + "\n", encoding="utf-8")
        pip = [sys.executable, "-m", "pip", "wheel", "-qq", "--no-deps", "--wheel-dir", str(folder.resolve()), str(ROOT)]
        subprocess.run(pip, cwd=ROOT, check=True)
    finally:
        shutil.rmtree(FOLDER, ignore_errors=True)
        shutil.rmtree(ROOT / "build", ignore_errors=True)
    (wheel,) = folder.glob("skugga-*.whl")
    print(f"{wheel}: {wheel.stat().st_size / 2**20:.1f} MiB")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else ROOT / "dist")
