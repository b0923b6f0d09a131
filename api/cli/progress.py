"""Progress of long work: bars and spinners on a terminal, lines elsewhere. Rich is imported when one is shown."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID


AdvanceCallback = Callable[[int, int], None]
"""Callback with the number of finished blocks (or other units of work) and their total."""


@contextmanager
def spinner(title: str) -> Iterator[None]:
    """Show a spinner on a terminal during work of unknown progress."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(title):
        yield


class ProgressBar:
    """A progress bar on a terminal for four or more blocks; silent elsewhere. ``with`` returns the callback for finished blocks."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._bar: tuple[Progress, TaskID] | None = None

    def __enter__(self) -> AdvanceCallback:
        return self._advance

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar[0].stop()

    def _advance(self, done: int, total: int) -> None:
        """Show the number of finished blocks of ``total``. Fewer than four blocks show no bar."""
        if total < 4 or not sys.stderr.isatty():
            return
        if self._bar is None:
            from rich.console import Console
            from rich.progress import Progress

            progress = Progress(console=Console(stderr=True), transient=True)
            self._bar = progress, progress.add_task(self._title, total=total)
            progress.start()
        self._bar[0].update(self._bar[1], completed=done)


class ProgressLines:
    """Lines on standard error, and on a terminal a progress bar below them as soon as one unit is done. A context manager."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._bar: tuple[Progress, TaskID] | None = None

    @cached_property
    def _console(self) -> Console:
        """The console of standard error."""
        from rich.console import Console

        return Console(stderr=True)

    def __enter__(self) -> ProgressLines:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar[0].stop()

    @property
    def is_terminal(self) -> bool:
        """Whether standard error is a terminal."""
        return self._console.is_terminal

    def print_status(self, text: str) -> None:
        """Print a dim line on a terminal; print nothing elsewhere."""
        if self.is_terminal:
            self._console.print(text, style="dim", highlight=False, markup=False)

    def print_line(self, text: str) -> None:
        """Print a line above the bar."""
        if not self.is_terminal:
            typer.echo(text, err=True)
        else:
            self._console.print(text, highlight=False, markup=False)

    def advance(self, done: int, total: int) -> None:
        """Show the number of finished units of work, and their total, in the progress bar of a terminal."""
        if not self.is_terminal:
            return
        if self._bar is None:
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            columns = TextColumn(self._title), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
            progress = Progress(*columns, console=self._console, transient=True)
            self._bar = progress, progress.add_task("", total=total)
            progress.start()
        self._bar[0].update(self._bar[1], completed=done, total=total)
