"""Build the documentation site: put its pages together in ``build/site-source``, then run MkDocs, which ``mkdocs.yml`` configures.

Run ``python -m scripts.build_site [FOLDER]``; the default folder is ``site``. A dead link or a missing anchor is an error.
``--commit-version`` also commits the site to the local branch ``gh-pages``, in a folder of the package's version, beside those of
earlier versions.

Pages link to each other as GitHub shows them, by paths in the repository. In the site, the files of ``docs`` are at its top. All
other published files keep their paths.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import posixpath
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from scripts.reference_pages import REFERENCE_FILES

ROOT = Path(__file__).resolve().parents[1]
SOURCE_FOLDER = ROOT / "build" / "site-source"
DOCS = "docs"

PUBLISHED = ("docs", "examples", "SECURITY.md", "CHANGELOG.md", "CODE_OF_CONDUCT.md", "CITATION.cff", "LICENSE")
"""Files and folders of the repository that the site has."""

NOTEBOOK = "a-winters-day.ipynb"
"""Notebook in ``docs`` that the site shows as a page. Its file is there, too."""

LINK = re.compile(r"(?<=\]\()(?![a-z]+:)([^)\s#]+)(#[^)\s]*)?(?=\))")
"""Target of a link in Markdown, and its anchor, unless the target is a URL or an anchor of the same page."""


def main(folder: Path, commit: bool = False) -> int:
    """Build the site in ``folder`` and return the exit status of MkDocs.

    Parameters
    ----------
    folder
        The folder, which is emptied.
    commit
        Whether a site without errors is also committed as this version's (``commit_version``).
    """
    write_source(SOURCE_FOLDER)
    # Not --quiet: it also keeps MkDocs from counting the warnings that --strict makes errors.
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder.resolve())]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    build = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if build.returncode:
        print(build.stdout, file=sys.stderr)
    else:
        pages = len(list(folder.rglob("*.html")))
        print(f"{folder}: {pages} pages. Look at them: python3 -m http.server --directory {folder}")
        if commit:
            commit_version()
    return build.returncode


def commit_version() -> None:
    """Build the site once more, with a menu of versions, and commit it to the branch ``gh-pages`` as the latest version.

    Nothing is pushed. The branch is what a host of static pages serves: a folder for each version, and ``latest``.

    Raises
    ------
    subprocess.CalledProcessError
        If mike, which commits it, fails.
    """
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    tools = Path(sys.executable).parent
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1", "SITE_VERSIONS": "mike", "SITE_FOLDER": folder}
        environment["PATH"] = f"{tools}{os.pathsep}{os.environ.get('PATH', '')}"  # mike runs mkdocs
        for arguments in (("deploy", "--update-aliases", version, "latest"), ("set-default", "latest")):
            subprocess.run([tools / "mike", *arguments], cwd=ROOT, env=environment, check=True)
    print(f"branch gh-pages: version {version}, which is now the latest; nothing was pushed")


def write_source(folder: Path) -> None:
    """Write all pages and files of the site into an empty folder, the generated ones among them."""
    shutil.rmtree(folder, ignore_errors=True)
    files: dict[str, str | bytes] = {f"reference/{name}": write() for name, write in REFERENCE_FILES.items()}
    files |= notebook_files(ROOT / DOCS / NOTEBOOK)
    paths = published_paths()
    for path in paths:
        content = (ROOT / path).read_bytes()
        files[site_path(path)] = with_site_links(content.decode(), path, paths) if path.endswith(".md") else content
    for name, text_or_bytes in files.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(text_or_bytes if isinstance(text_or_bytes, bytes) else text_or_bytes.encode())


def published_paths() -> list[str]:
    """Return the paths in the repository of the files of ``PUBLISHED``, also of new ones that git does not know yet."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", *PUBLISHED]
    try:
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):  # a copy of the tree without git
        found = [path for name in PUBLISHED for path in ([ROOT / name] if (ROOT / name).is_file() else (ROOT / name).rglob("*"))]
        listed = [str(path.relative_to(ROOT)) for path in found if "__pycache__" not in path.parts]
    return sorted({path for path in listed if (ROOT / path).is_file()})


def site_path(path: str) -> str:
    """Return the path in the site's sources of a file of the repository."""
    return path.removeprefix(f"{DOCS}/")


def with_site_links(markdown: str, path: str, published: Iterable[str]) -> str:
    """Return the text of a page whose links lead to where the site has their targets.

    Parameters
    ----------
    markdown
        The text.
    path
        Path of the page in the repository.
    published
        Paths in the repository of all files that the site has.

    Returns
    -------
    str
        The text. Links to other files stay as they are, and MkDocs reports those that lead nowhere.
    """
    known = {*published, f"{DOCS}/{Path(NOTEBOOK).stem}.md"}

    def site_link(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(path), match[1]))
        if posixpath.basename(target) == NOTEBOOK:
            target = target.removesuffix(".ipynb") + ".md"
        if target not in known:
            return match[0]
        return posixpath.relpath(site_path(target), posixpath.dirname(site_path(path)) or ".") + (match[2] or "")

    return LINK.sub(site_link, markdown)


def notebook_files(path: Path) -> dict[str, str | bytes]:
    """Return a notebook as a page, with its pictures as files beside it, by their paths in the site's sources.

    Code is shown with what it printed and drew when the notebook was run.
    """
    files: dict[str, str | bytes] = {}
    parts: list[str] = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            data: dict[str, Any] = output.get("data", {})
            if "image/png" in data:
                name = f"images/{path.stem}-{len(files) + 1}.png"
                files[name] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![Drawn by the code above]({name})")
            elif text := "".join(output.get("text", data.get("text/plain", []))).rstrip():
                parts.append(f"```text\n{text}\n```")
    return {**files, f"{path.stem}.md": "\n\n".join(parts) + "\n"}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition(":")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "site", metavar="FOLDER")
    parser.add_argument("--commit-version", action="store_true", help="also commit the site to the local branch gh-pages")
    options = parser.parse_args()
    sys.exit(main(options.folder, options.commit_version))
