"""What a caller asks for, whatever the front end: the sun, the look and the shadows, and the product with its options."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

from pydantic import BaseModel, ConfigDict, SerializeAsAny, field_validator, model_validator

from skugga.api.products import PRODUCTS, product_named
from skugga.api.products.product import Product, ProductOptions
from skugga.terrain.level.level import Shadows, override, parse_algorithm
from skugga.terrain.level.parts import SlopeExaggeration, StyleName, SunSpec

if TYPE_CHECKING:
    from skugga.terrain.scene import Scene


class _Value(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RequestedSettings(_Value):
    """What a request asks of the shadows: keys of a level's ``shadows`` and their values, in the order of the keys there.

    ``algorithm`` is as the query spells it. A key that is not asked for is not among them: the level has its say. What else a
    request asks is a field of ``PictureRequest``.
    """

    asked: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, asked: Mapping[str, Any]) -> RequestedSettings:
        """Of keys and values; ``None`` asks for nothing. Raises ``InputError``."""
        ordered = {**dict.fromkeys(Shadows.model_fields), **asked}
        return cls(asked=tuple((key, value) for key, value in ordered.items() if value is not None))

    @field_validator("asked")
    @classmethod
    def _allowed(cls, asked: tuple[tuple[str, Any], ...]) -> tuple[tuple[str, Any], ...]:
        override(Shadows(), _unspelt(asked))
        return asked

    def for_selector(self) -> dict[str, Any]:
        """As policies of ``skugga.selector.select`` take them."""
        return _unspelt(self.asked)


def _unspelt(asked: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    return {key: parse_algorithm(value) if key == "algorithm" else value for key, value in asked}


class PictureRequest(_Value):
    """What a request asks whatever the view: of the sun (``None``: the level's own), of how it looks (likewise) and of the shadows.

    Jobs carry it whole, and entity tags and caches of plans know all of it: a field more needs nothing but its line in
    ``seen``.
    """

    sun: SunSpec | None = None
    style: StyleName | None = None
    slope_exaggeration: SlopeExaggeration | None = None
    overrides: RequestedSettings = RequestedSettings()

    def query(self, **more: str) -> str:
        """The same as a query string, with other parameters before it; empty where nothing is asked."""
        own = self.model_dump(mode="json", exclude_none=True, exclude={"overrides"})
        return urlencode({**more, **own.pop("sun", {}), **own, **dict(self.overrides.asked)})

    def seen(self, scene: Scene) -> Scene:
        """A level's scene as the request wants to see it."""
        return scene.with_sun(self.sun).with_style(self.style, self.slope_exaggeration)


class ProductRequest(PictureRequest):
    """A product with its options, under a sun. It is the same value wherever the same picture is asked for.

    What the product does not depend on is dropped: the style of all but colours, and sun and shadows of what has no moment.
    """

    product: str = "color"
    options: SerializeAsAny[ProductOptions] = ProductOptions()

    @model_validator(mode="before")
    @classmethod
    def _normalised(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        product, found = product_named(values.get("product", "color")), dict(values)
        if product.when != "sun":
            found |= {"sun": None, "overrides": RequestedSettings()}
        if not product.is_display:
            found |= {"style": None, "slope_exaggeration": None}
        options = found.get("options", {})
        if type(options) is not product.options:
            found["options"] = product.options_of(dict(options))
        return found

    @property
    def record(self) -> Product:
        """The product."""
        return PRODUCTS[self.product]

    @property
    def picture(self) -> PictureRequest:
        """What is asked of any picture."""
        return PictureRequest(**{name: getattr(self, name) for name in PictureRequest.model_fields})

    def under(self, sun: SunSpec | None) -> ProductRequest:
        """Return the request under another sun."""
        return ProductRequest(**{**dict(self), "sun": sun})

    def product_query(self) -> str:
        """Return what is asked besides the product, as a query string."""
        return "&".join(part for part in (self.options.query(), self.picture.query()) if part)

    def query(self, **more: str) -> str:
        """Return the request as a query string; empty where it asks for the level's own colours."""
        product = {} if self.product == "color" else {"layer": self.product}
        return "&".join(part for part in (urlencode({**more, **product}), self.product_query()) if part)
