"""Build and check what a package index gets: a wheel with the viewer and compiled loops, and a source distribution.

Run ``python -m scripts.make_release [FOLDER]``; the default folder is ``dist``. The wheel is installed into an empty environment,
where a user with an empty home draws a first picture. Nothing is uploaded.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

from scripts import make_wheel

ROOT = Path(__file__).resolve().parents[1]

MIN_RATING = 8
"""Minimum rating by pyroma, of 10. A project without a public address loses one, and one without an e-mail address another."""

FIRST_PICTURE = ("render", "jacksboro", "--size", "600x400", "-o", "first.png")
"""Arguments of the command that draws the first picture."""


def main(folder: Path) -> None:
    """Build, check, install, and draw. Raises ``subprocess.CalledProcessError`` for a step that fails."""
    for old in folder.glob("skugga-*"):
        old.unlink()
    make_wheel.main(folder)
    run("-m", "build", "--sdist", "--outdir", str(folder), str(ROOT))
    (wheel,), (archive,) = folder.glob("skugga-*.whl"), folder.glob("skugga-*.tar.gz")
    run("-m", "twine", "check", "--strict", str(wheel), str(archive))
    run("-m", "pyroma", "--min", str(MIN_RATING), str(archive))
    with tempfile.TemporaryDirectory() as temporary:
        picture = first_picture(wheel, Path(temporary))
    print(f"{wheel.name}, {archive.name}: checked; the first picture of an empty environment has {picture} bytes")


def run(*arguments: str) -> None:
    """Run this Python with some arguments, in the root of the repository."""
    subprocess.run([sys.executable, *arguments], cwd=ROOT, check=True)


def first_picture(wheel: Path, folder: Path) -> int:
    """Install a wheel into an empty environment below ``folder``, draw a picture there, and return its size in bytes."""
    venv.create(folder / "env", with_pip=True)
    python, home = folder / "env" / "bin" / "python", folder / "home"
    home.mkdir()
    pip = [str(python), "-m", "pip", "install", "-qq", "-c", str(ROOT / "requirements.lock"), str(wheel)]
    # Without PYTHONPATH: pip would take a package there for installed.
    subprocess.run(pip, check=True, cwd=folder, env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"})
    variables = {name: value for name, value in os.environ.items() if name in ("PATH", "LANG", "SKUGGA_EXPECT_RENDERER")}
    subprocess.run([python.with_name("skugga"), *FIRST_PICTURE], check=True, cwd=folder, env={**variables, "HOME": str(home)})
    data = (folder / "first.png").read_bytes()
    if not data.startswith(b"\x89PNG"):
        raise ValueError("first.png is no PNG picture")
    return len(data)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve() if sys.argv[1:] else ROOT / "dist")
