"""What long work shows: a line for each part that is done, with a bar and the time left below on a terminal."""

from __future__ import annotations

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn


class LinesOverBar:
    """Lines on standard error; on a terminal with a bar under them, from the first part on that is done. Used by ``with``."""

    def __init__(self, task: str) -> None:
        self._task = task
        self._bar: tuple[Progress, TaskID] | None = None
        self._console = Console(stderr=True)

    def __enter__(self) -> LinesOverBar:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar[0].stop()

    @property
    def on_terminal(self) -> bool:
        """Whether somebody is looking."""
        return self._console.is_terminal

    def say(self, text: str) -> None:
        """What is told on a terminal alone."""
        if self.on_terminal:
            self._console.print(text, style="dim", highlight=False, markup=False)

    def line(self, text: str) -> None:
        """A line, above the bar."""
        if not self.on_terminal:
            typer.echo(text, err=True)
        else:
            self._console.print(text, highlight=False, markup=False)

    def advance(self, done: int, total: int) -> None:
        """So many parts are done."""
        if not self.on_terminal:
            return
        if self._bar is None:
            columns = TextColumn(self._task), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
            progress = Progress(*columns, console=self._console, transient=True)
            self._bar = progress, progress.add_task("", total=total)
            progress.start()
        self._bar[0].update(self._bar[1], completed=done, total=total)
