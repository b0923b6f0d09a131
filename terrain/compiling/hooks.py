"""Hooks that compile all missing loops of a product at once, when the disk cache lacks one of them.

A loop is a function that numba compiles. This module imports no numba, so that commands with a fast start may use it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

CompileFunction = Callable[[Sequence[str]], None]
"""Callback that compiles all loops that some products need. Its argument are names in ``ahead_of_time.PRODUCTS``."""

_compilers: list[CompileFunction] = []
_needed_products: list[str] = []
_compiled_products: set[str] = set()
_is_grouping_enabled = True


def declare_product(product: str) -> None:
    """Declare a product (one of ``ahead_of_time.PRODUCTS``) that this process computes.

    If a loop is missing, all missing loops of the declared products are compiled together.
    """
    if product not in _needed_products:
        _needed_products.append(product)


@contextmanager
def missing_loop_compiler(compile_products: CompileFunction) -> Iterator[None]:
    """Register, within the block, a function that compiles the loops of the declared products.

    It is called with these products when the disk cache lacks a loop. It is called again only after further products were declared.
    Any other missing loop is compiled on its own, when it is first called.
    """
    _compilers.append(compile_products)
    try:
        yield
    finally:
        _compilers.remove(compile_products)


def compile_lazily() -> None:
    """Compile each missing loop of this process on its own from now on, when it is first called.

    The function that ``missing_loop_compiler`` registers is no longer called.
    """
    global _is_grouping_enabled
    _is_grouping_enabled = False


def compile_needed_products() -> bool:
    """Compile the loops of the declared products that are not compiled yet, and return whether any product was left.

    If so, the disk cache may now hold the loop that was missing. Returns ``False`` without a registered function, and after
    ``compile_lazily``.
    """
    products = [product for product in _needed_products if product not in _compiled_products]
    if not products or not _compilers or not _is_grouping_enabled:
        return False
    _compiled_products.update(products)
    _compilers[-1](products)
    return True
