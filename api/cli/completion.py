"""What shells complete on a command line: words of options, and levels. Where nothing fits, shells complete files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from pathlib import Path

from skugga.api.catalogue import RASTER_SUFFIXES, bundled_levels
from skugga.terrain.level.rasters import LEVEL_SUFFIXES


def complete_words(words: Iterable[object]) -> Callable[[str], list[str]]:
    """Return a function that completes any of some words, as Typer takes one for an option.

    Parameters
    ----------
    words
        All words, in the order in which they are offered. They are read when something is completed.

    Examples
    --------
    >>> complete_words(["auto", "natural", "analysis"])("a")
    ['auto', 'analysis']
    """

    def complete(incomplete: str) -> list[str]:
        return [word for word in map(str, words) if word.startswith(incomplete)]

    return complete


def complete_level(incomplete: str) -> list[str]:
    """Complete the name of a bundled level, or that of a level file, a raster or a folder.

    Parameters
    ----------
    incomplete
        What is typed so far.

    Returns
    -------
    list of str
        Names, then files; nothing where only folders fit, since shells complete those better: without a space behind them.
    """
    names = [path.stem for path in bundled_levels() if path.stem.startswith(incomplete)]
    folder, begin = os.path.split(incomplete)
    try:
        beside = sorted(Path(os.path.expanduser(folder) or ".").iterdir())
    except OSError:
        return names
    shown = [path for path in beside if path.name.startswith(begin) and (begin.startswith(".") or not path.name.startswith("."))]
    files = [path.name for path in shown if path.suffix.lower() in (*LEVEL_SUFFIXES, *RASTER_SUFFIXES) and path.is_file()]
    if not names and not files:
        return []
    folders = [f"{path.name}/" for path in shown if path.is_dir()]
    return [*names, *(os.path.join(folder, name) for name in sorted([*files, *folders]))]
