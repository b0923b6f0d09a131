"""Build a wheel with the viewer and with all loops compiled for x86-64-v3.

Run ``python scripts/make_wheel.py [FOLDER]``; the default folder is ``dist``. The compiled loops fit this version of Python and the
installed versions of numba and NumPy. With other versions an installed wheel compiles its loops on first use.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from skugga.terrain.compiling.bundle import BUNDLED_LOOPS_FOLDER, NUMBA_TARGET, VERSIONS_FILE, installed_versions

ROOT = Path(__file__).resolve().parents[1]


COMPILE_CODE = """
import shutil, subprocess, sys
from skugga.terrain.compiling.ahead_of_time import PRODUCTS, compile_ahead
from skugga.terrain.compiling.farm import named_tasks
from skugga.terrain.compiling.loop_cache import loop_store
from skugga.terrain.compiling.store import ENTRY_SUFFIX
compile_ahead(PRODUCTS, int(sys.argv[1]))
for _, name in named_tasks(PRODUCTS):
    shutil.copy(loop_store().folder / (name + ENTRY_SUFFIX), sys.argv[2])
"""
"""Python code of a subprocess: compile all loops for ``NUMBA_TARGET`` and copy the machine code into a folder.

Its arguments are the number of cores and the folder.
"""


def main(folder: Path) -> None:
    """Compile the loops, build the wheel in ``folder``, and remove the compiled loops from the source tree.

    A checkout has no compiled loops, since it compiles them for its own processor.
    """
    shutil.rmtree(BUNDLED_LOOPS_FOLDER, ignore_errors=True)
    shutil.rmtree(ROOT / "build", ignore_errors=True)  # leftovers of an earlier build would get into the wheel
    try:
        BUNDLED_LOOPS_FOLDER.mkdir()
        cores = str(len(os.sched_getaffinity(0)))
        subprocess.run(
            [sys.executable, "-c", COMPILE_CODE, cores, BUNDLED_LOOPS_FOLDER],
            env={**os.environ, **NUMBA_TARGET},
            cwd=ROOT,
            check=True,
        )
        for entry in BUNDLED_LOOPS_FOLDER.iterdir():
            entry.chmod(0o644)
        (BUNDLED_LOOPS_FOLDER / VERSIONS_FILE).write_text(json.dumps(installed_versions(), indent=1) + "\n", encoding="utf-8")
        pip = [
            sys.executable,
            "-m",
            "pip",
            "wheel",
            "-qq",
            "--no-deps",
            "--wheel-dir",
            str(folder.resolve()),
        ]
        subprocess.run([*pip, str(ROOT)], cwd=ROOT, check=True)
    finally:
        shutil.rmtree(BUNDLED_LOOPS_FOLDER, ignore_errors=True)
        shutil.rmtree(ROOT / "build", ignore_errors=True)
    (wheel,) = folder.glob("skugga-*.whl")
    print(f"{wheel}: {wheel.stat().st_size / 2**20:.1f} MiB")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if sys.argv[1:] else ROOT / "dist")
