"""Hooks for loops that the cache lacks. Imports no numba, so that commands with a fast start may register them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

CompileFunction = Callable[[Sequence[str]], None]
"""Callback that compiles all loops that some products need."""

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
    """Within the block, call a function with the needed products on the first missing loop.

    The function is called again only after further products were declared. Other missing loops are compiled one by one.
    """
    _compilers.append(compile_products)
    try:
        yield
    finally:
        _compilers.remove(compile_products)


def compile_lazily() -> None:
    """From now on compile each loop in this process on its first call, regardless of the needed products."""
    global _is_grouping_enabled
    _is_grouping_enabled = False


def compile_needed_products() -> bool:
    """Compile the needed products that are not compiled yet. Return whether there were any: if so, the loop may now be stored."""
    products = [product for product in _needed_products if product not in _compiled_products]
    if not products or not _compilers or not _is_grouping_enabled:
        return False
    _compiled_products.update(products)
    _compilers[-1](products)
    return True
