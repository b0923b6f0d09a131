"""Entry point of the command line.

Exit statuses are 0 (success), 1 (the work failed) and 2 (wrong input). An error is one line on standard error.
This module imports nothing that computes, so that help, completion and usage errors are fast. ``lazy_commands`` has the commands.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from typing import Annotated, Any

import typer

from skugga.api.cli.lazy_commands import CommandGroup
from skugga.api.errors import exit_status, with_option_names
from skugga.terrain.compiling.bundle import use_bundled_loops
from skugga.terrain.compiling.hooks import missing_loop_compiler
from skugga.terrain.errors import InputError, SkuggaError, printable
from skugga.terrain.level.gdal_guard import forbid_python_code, limit_gdal_caches

app = typer.Typer(
    cls=CommandGroup,
    help="Terrain with the sun's true cast shadows.",
    no_args_is_help=True,
    rich_markup_mode=None,  # plain help: Rich takes as long to import as all else that help needs
    context_settings={"max_content_width": 110},
    pretty_exceptions_enable=False,
)

_UsageError: Any = typer.BadParameter.__mro__[1]
"""Typer's usage error, which Typer does not export."""


def _print_version(is_requested: bool) -> None:
    """Print the version and exit, if the option ``--version`` is used."""
    if is_requested:
        typer.echo(f"skugga {version('skugga')}")
        raise typer.Exit


@app.callback()
def _global_options(
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Terrain with the sun's true cast shadows."""


def main() -> None:
    """Entry point of ``skugga``."""
    use_bundled_loops()
    debug = "--debug" in sys.argv[1:]
    forbid_python_code()
    limit_gdal_caches()
    try:
        with _signals_as_exceptions(), missing_loop_compiler(_compile_products):
            status = app(sys.argv[1:] or ["--help"], prog_name="skugga", standalone_mode=False)
    except _UsageError as error:
        status = _print_error(error.format_message(), 2)
    except typer.Abort:
        status = _print_error("interrupted", 1)
    except SkuggaError as error:
        if debug:
            raise
        status = _print_error(
            str(error), exit_status(error), has_several_errors=isinstance(error, InputError) and bool(error.further_errors)
        )
    except OSError as error:
        if debug:
            raise
        status = _print_error(f"{error.filename or 'output'}: {error.strerror or error}", 1)
    except MemoryError as error:
        if debug:
            raise
        status = _print_error(f"no memory is left ({error or 'an allocation failed'}). Use a smaller picture or fewer products", 1)
    except Exception as error:
        cause = error.__cause__
        if isinstance(error, SystemError) and isinstance(cause, SystemExit | KeyboardInterrupt):  # signal in a compiled loop
            sys.exit(cause.code if isinstance(cause, SystemExit) else _print_error("interrupted", 1))
        if debug:
            raise
        status = _print_error(f"internal error: {type(error).__name__}: {error}. Use --debug to print the traceback", 1)
    sys.exit(status if isinstance(status, int) else 0)


def _compile_products(products: Sequence[str]) -> None:
    """Compile the loops that products need, when the engine first declares them. ``compile_for_command`` shows the progress."""
    from skugga.api.cli.compiling import compile_for_command

    compile_for_command(products)


@contextmanager
def _signals_as_exceptions() -> Iterator[None]:
    """Turn signals that end the process into an exception, so that cleanup removes partial files."""

    def raise_exit(signal_number: int, _: object) -> None:
        signal.signal(signal_number, signal.SIG_IGN)  # a second signal must not interrupt the cleanup
        sys.exit(128 + signal_number)

    numbers = [number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) is signal.SIG_DFL]
    for number in numbers:
        signal.signal(number, raise_exit)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)


def _print_error(message: str, status: int, has_several_errors: bool = False) -> int:
    """Print an error as one line, or as one line per error if ``has_several_errors`` is true; return the exit status."""
    for line in message.split("\n") if has_several_errors else [message]:
        typer.echo(printable(f"skugga: {' '.join(with_option_names(line).split())}"), err=True)
    return status
