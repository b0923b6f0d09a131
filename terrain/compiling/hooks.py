"""What a process does when it meets a loop that is stored nowhere. Imports no numba, so that light commands may set it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

Compile = Callable[[Sequence[str]], None]
"""Compiles all that some products need."""

_compilers: list[Compile] = []
_needed: list[str] = []
_compiled: set[str] = set()
_is_ahead = True


def need(product: str) -> None:
    """Declare what is being made (one of ``ahead.PRODUCTS``): if a loop is missing, all loops of it are compiled together."""
    if product not in _needed:
        _needed.append(product)


@contextmanager
def compiled_by(compile_products: Compile) -> Iterator[None]:
    """Within the block, call a function with the products that are needed when a loop is first found missing.

    It is called again only when other products are needed. Loops that are missing after that are compiled one by one.
    """
    _compilers.append(compile_products)
    try:
        yield
    finally:
        _compilers.remove(compile_products)


def compile_when_called() -> None:
    """From now on compile each loop in this process when it is called, whatever product is needed."""
    global _is_ahead
    _is_ahead = False


def report_missing_loop() -> bool:
    """Compile the products that are needed; return whether any was, so that the loop may be stored by now."""
    products = [product for product in _needed if product not in _compiled]
    if not products or not _compilers or not _is_ahead:
        return False
    _compiled.update(products)
    _compilers[-1](products)
    return True
