"""Shell completion of option values and levels. Without a match, shells complete file names themselves."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from skugga.api.catalogue import RASTER_SUFFIXES, bundled_levels
from skugga.terrain.level.rasters import LEVEL_SUFFIXES


def complete_words(words: Iterable[object]) -> Callable[[str], list[str]]:
    """Return a completion function for an option of Typer.

    Parameters
    ----------
    words
        All values, in the order of the suggestions. They are read at the time of completion.

    Returns
    -------
    callable
        Function of the incomplete word that returns the matching words.

    Examples
    --------
    >>> complete_words(["auto", "natural", "analysis"])("a")
    ['auto', 'analysis']
    """

    def complete(incomplete: str) -> list[str]:
        return [word for word in map(str, words) if word.startswith(incomplete)]

    return complete


def complete_level(incomplete: str) -> list[str]:
    """Return the bundled levels, level files, rasters and folders that begin with a text.

    Parameters
    ----------
    incomplete
        The text typed so far.

    Returns
    -------
    list of str
        Names of bundled levels, then files and folders. Empty if only folders match, because shells then complete them without a
        space after the name.
    """
    names = [path.stem for path in bundled_levels() if path.stem.startswith(incomplete)]
    folder, prefix = os.path.split(incomplete)
    try:
        entries = sorted(Path(os.path.expanduser(folder) or ".").iterdir())
    except OSError:
        return names
    matches = [
        path for path in entries if path.name.startswith(prefix) and (prefix.startswith(".") or not path.name.startswith("."))
    ]
    files = [path.name for path in matches if path.suffix.lower() in (*LEVEL_SUFFIXES, *RASTER_SUFFIXES) and path.is_file()]
    if not names and not files:
        return []
    folders = [f"{path.name}/" for path in matches if path.is_dir()]
    return [*names, *(os.path.join(folder, name) for name in sorted([*files, *folders]))]
