"""Options of products as command-line options."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, get_args

import typer

from skugga.api.cli.completion import complete_words
from skugga.api.products import PRODUCTS
from skugga.api.products.product import Product, ProductOptions
from skugga.api.signature_parameters import FunctionT, with_parameters
from skugga.terrain.errors import InputError, Problem


def with_product_options(products: Sequence[str], after_parameter: str) -> Callable[[FunctionT], FunctionT]:
    """Return a decorator that replaces ``**declared_options`` of a command by the options of ``products``.

    They come after the parameter named ``after_parameter``.
    """
    names = dict.fromkeys(name for product in products for name in PRODUCTS[product].options.model_fields)
    return with_parameters([(name, _product_option(name, products)) for name in names], after_parameter)


def split_product_options(product: Product, declared_options: dict[str, Any]) -> tuple[ProductOptions, dict[str, Any]]:
    """Split a command's options into those of a product and the remaining ones. Raises ``InputError``."""
    fields = product.options.model_fields
    foreign_names = {name for other_product in PRODUCTS.values() for name in other_product.options.model_fields} - fields.keys()
    for name in sorted(foreign_names):
        if declared_options.get(name) is not None:
            owners = " or ".join(
                other_product.name for other_product in PRODUCTS.values() if name in other_product.options.model_fields
            )
            raise InputError(_option_flag(name), Problem(f"is an option of {owners}, not of {product.name}"), "Leave it out")
    own_values = {name: value for name, value in declared_options.items() if name in fields and value is not None}
    try:
        options = product.options_of(own_values)
    except InputError as error:
        raise error.renamed(_option_flag(error.name)) from None
    return options, {name: value for name, value in declared_options.items() if name not in fields and name not in foreign_names}


def _option_flag(name: str) -> str:
    """Return the command-line flag of a product option, such as ``--min-altitude`` for ``min_altitude``."""
    return f"--{name.replace('_', '-')}"


def _product_option(name: str, products: Sequence[str]) -> Any:
    """Return the annotation of a product option as a command option. Its value is text, which the product parses."""
    owners = [product for product in products if name in PRODUCTS[product].options.model_fields]
    field = PRODUCTS[owners[0]].options.model_fields[name]
    kinds = {*get_args(field.annotation), field.annotation}
    value_type: Any = bool if bool in kinds else str
    metavar = next((name_of for kind, name_of in ((int, "WHOLE"), (float, "NUMBER")) if kind in kinds), None)
    help_text = f"{', '.join(owners)}: {(field.description or '').replace('`', '')}"
    words = [word for word in get_args(field.annotation) if isinstance(word, str)]
    return Annotated[
        value_type | None, typer.Option(_option_flag(name), help=help_text, metavar=metavar, autocompletion=complete_words(words))
    ]
