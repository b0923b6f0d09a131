"""Requests of all front ends: the sun, the style and the shadow settings, and the product with its options."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import urlencode

from pydantic import AfterValidator, BaseModel, ConfigDict, SerializeAsAny, field_validator, model_validator

from skugga.api.products import PRODUCTS, product_named
from skugga.api.products.product import Product, ProductOptions
from skugga.terrain.color_ramp import canonical_ramp_text, parse_ramp
from skugga.terrain.level.level import Shadows, override_settings, parse_algorithm
from skugga.terrain.level.parts import Generalisation, LocalLightDeg, SkyName, SlopeExaggeration, StyleName, SunSpec

if TYPE_CHECKING:
    from skugga.terrain.scene import Scene


class _RequestModel(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class RequestedSettings(_RequestModel):
    """Shadow settings of a request: keys of a level's ``shadows`` and their values, in the order of the fields of ``Shadows``.

    ``algorithm`` is spelt as in the query. Keys that are not requested are absent, so the level's values apply. All other parts of
    a request are fields of ``PictureRequest``.
    """

    asked: tuple[tuple[str, Any], ...] = ()

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> RequestedSettings:
        """Build requested settings from keys and values. Values that are ``None`` are omitted. Raises ``InputError``."""
        ordered = {**dict.fromkeys(Shadows.model_fields), **settings}
        return cls(asked=tuple((key, value) for key, value in ordered.items() if value is not None))

    @field_validator("asked")
    @classmethod
    def _check_settings(cls, settings: tuple[tuple[str, Any], ...]) -> tuple[tuple[str, Any], ...]:
        override_settings(Shadows(), _parsed_settings(settings))
        return settings

    def for_selector(self) -> dict[str, Any]:
        """Return the settings in the form that the policies of ``skugga.selector.select`` take."""
        return _parsed_settings(self.asked)


def _parsed_settings(settings: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    """Return settings by key, with ``algorithm`` parsed from its spelling in queries."""
    return {key: parse_algorithm(value) if key == "algorithm" else value for key, value in settings}


class PictureRequest(_RequestModel):
    """The part of a request that is independent of the view: the sun, the style and the shadow settings.

    ``None`` keeps the level's own value. Jobs carry the whole model, and entity tags and plan caches include all of it. A new field
    only needs a line in ``applied_to``. ``ramp`` is a colour ramp as text (``skugga.terrain.color_ramp``), in its one spelling.
    """

    sun: SunSpec | None = None
    style: Literal["auto"] | StyleName | None = None
    slope_exaggeration: SlopeExaggeration | None = None
    sky: SkyName | None = None
    ramp: Annotated[str, AfterValidator(canonical_ramp_text)] | None = None
    local_light: LocalLightDeg | None = None
    generalisation: Generalisation | None = None
    overrides: RequestedSettings = RequestedSettings()

    def query(self, **parameters: str) -> str:
        """Return the request as a query string, which begins with ``parameters``; empty if nothing is requested."""
        fields = self.model_dump(mode="json", exclude_none=True, exclude={"overrides"})
        return urlencode({**parameters, **fields.pop("sun", {}), **fields, **dict(self.overrides.asked)})

    def applied_to(self, scene: Scene) -> Scene:
        """Return a level's scene with the requested sun and style."""
        return scene.with_sun(self.sun).with_style(
            self.style,
            self.slope_exaggeration,
            self.sky,
            None if self.ramp is None else parse_ramp(self.ramp),
            self.local_light,
            self.generalisation,
        )


STYLE_FIELDS = "style", "slope_exaggeration", "sky", "ramp", "local_light", "generalisation"
"""Fields of a ``PictureRequest`` that change the style alone."""


class ProductRequest(PictureRequest):
    """A product with its options, under a sun. Requests for the same picture are equal.

    Fields that do not affect the product are dropped: the style of a product that is not for display, and the sun and the shadow
    settings of a product that does not depend on a moment.
    """

    product: str = "color"
    options: SerializeAsAny[ProductOptions] = ProductOptions()

    @model_validator(mode="before")
    @classmethod
    def _drop_unused_fields(cls, values: Any) -> Any:
        if not isinstance(values, Mapping):
            return values
        product, fields = product_named(values.get("product", "color")), dict(values)
        if product.when != "sun":
            fields |= {"sun": None, "overrides": RequestedSettings()}
        if not product.is_display:
            fields |= dict.fromkeys(STYLE_FIELDS)
        options = fields.get("options", {})
        if type(options) is not product.options:
            fields["options"] = product.options_of(dict(options))
        return fields

    @property
    def product_record(self) -> Product:
        """The record of the product."""
        return PRODUCTS[self.product]

    @property
    def picture(self) -> PictureRequest:
        """The part of the request that is independent of the product."""
        return PictureRequest(**{name: getattr(self, name) for name in PictureRequest.model_fields})

    def with_sun(self, sun: SunSpec | None) -> ProductRequest:
        """Return the request under another sun."""
        return ProductRequest(**{**dict(self), "sun": sun})

    def product_query(self) -> str:
        """Return the request as a query string without the product's name."""
        return "&".join(part for part in (self.options.query(), self.picture.query()) if part)

    def query(self, **parameters: str) -> str:
        """Return the request as a query string; empty for the level's own colours."""
        product = {} if self.product == "color" else {"layer": self.product}
        return "&".join(part for part in (urlencode({**parameters, **product}), self.product_query()) if part)
