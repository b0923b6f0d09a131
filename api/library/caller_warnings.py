"""Warnings of the library, attributed to the line that called it."""

from __future__ import annotations

import sys
import warnings
from itertools import count

PACKAGE = __name__.partition(".")[0]


def warn_caller(message: str) -> None:
    """Issue a ``UserWarning`` for the nearest calling line outside of the package. Python then shows and filters that line."""
    for stack_level in count(2):
        try:
            module = sys._getframe(stack_level - 1).f_globals.get("__name__", "")
        except ValueError:  # the package alone is on the stack, as in a thread
            break
        if module.partition(".")[0] != PACKAGE:
            break
    warnings.warn(message, stacklevel=stack_level)
