"""Additions to a copy of the repository: a shadow setting, a product, and a query parameter of a picture.

Each addition edits only the files named here, and appears in every interface. ``docs/contributing.md`` states the same numbers of
files.
"""

from __future__ import annotations

import json

import pytest

from tests.api.conftest import write_level
from tests.copies import Edits, copy_with, run_module_json

A_SETTING: Edits = {
    "terrain/level/level.py": (
        (
            '    @field_validator("algorithm")\n',
            '    gloss: Literal["auto", "dull", "bright"] = Field(default="auto", description="How shadows shine.")\n\n'
            '    @field_validator("algorithm")\n',
        ),
    ),
}

STEEPNESS = '''
"""A made-up product: how steep the ground is, with a factor."""

import numpy as np
from pydantic import Field

from skugga.api.color_scale import ColorScale
from skugga.api.products.product import Product, ProductInput, ProductOptions


class SteepnessOptions(ProductOptions):
    gain: float = Field(default=1.0, ge=0.1, le=10.0, description="Factor of the steepness.", examples=[2])


def _compute(product_input: ProductInput) -> np.ndarray:
    """Rise per unit of the map, by central differences: a pixel more is needed on each side."""
    height_m, step = product_input.ground_height_m.astype(float), product_input.map_view.grid.step
    out = np.full(height_m.shape, np.nan, np.float32)
    across, down = height_m[1:-1, 2:] - height_m[1:-1, :-2], height_m[2:, 1:-1] - height_m[:-2, 1:-1]
    out[1:-1, 1:-1] = product_input.options.gain * np.hypot(across, down) / (2.0 * step)
    return out


PRODUCT = Product(
    name="steepness", description="made-up steepness of the ground", formats=("png", "tif", "npy"), compute=_compute,
    view_kinds=("map",), when="none", margin_px=1, options=SteepnessOptions, unit="1",
    color_scale=lambda options, world: ColorScale("Steepness", "viridis", 0.0, 2.0, ((0.0, "0"), (1.0, "1"), (2.0, "2"))),
)
'''

A_PRODUCT: Edits = {"api/products/steepness.py": (("", STEEPNESS),)}

A_PARAMETER: Edits = {
    "api/http/parameters.py": (
        (
            "    **shadow_settings: Any,\n) -> PictureRequest:",
            '    raised: Annotated[float | None, Query(description="Degrees more.")] = None,\n'
            "    **shadow_settings: Any,\n) -> PictureRequest:",
        ),
        ("    return PictureRequest(\n        sun=sun,", "    return PictureRequest(\n        raised=raised, sun=sun,"),
    ),
    "api/request.py": (
        (
            "    sun: SunSpec | None = None\n",
            "    sun: SunSpec | None = None\n    raised: float | None = None\n",
        ),
        (
            "        return scene.with_sun(self.sun).with_style(",
            "        sun = self.sun\n"
            "        if sun is not None and self.raised is not None:\n"
            "            sun = SunSpec(azimuth=sun.azimuth, altitude=sun.altitude + self.raised)\n"
            "        return scene.with_sun(sun).with_style(",
        ),
    ),
}  # fmt: skip


PERSPECTIVE_VIEW = {"kind": "perspective", "eye": [8.43, 47.5, 300], "target": [8.45, 47.51, 0]}


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict]:
    """Return the output of the probe on a copy with all additions, by addition."""
    folder = tmp_path_factory.mktemp("additions")
    levels = [write_level(folder, name, views={"across": PERSPECTIVE_VIEW}) for name in ("hills", "plane")]
    return run_module_json(copy_with(folder, {**A_SETTING, **A_PRODUCT, **A_PARAMETER}), "tests.probe", *levels)


def test_additions_edit_the_documented_number_of_files():
    """``docs/contributing.md`` states these numbers. They do not include code that uses the addition."""
    assert [len(edits) for edits in (A_SETTING, A_PRODUCT, A_PARAMETER)] == [1, 1, 2]


def test_a_new_setting_appears_in_every_interface(output):
    answers = output["setting"]

    value, refusal = answers["level file"]
    assert value == "bright" and "shadows.gloss" in refusal and "'dull'" in refusal
    for name, text in answers["help"].items():
        assert "--gloss" in text and "How shadows shine (dull or bright)." in text, name

    unused_reason = {
        "name": "gloss bright",
        "reason": "set by the request, without effect: no chosen algorithm has this setting",
    }
    (status, _, err), reasons = answers["render"]
    assert status == 0 and unused_reason in reasons, err
    status, out, err = answers["select"]
    assert status == 0 and unused_reason in json.loads(out)["reasons"], err
    assert unused_reason in answers["plan of facts"]
    status, _, err = answers["refused"]
    assert status == 2 and "gloss" in err and "loud" in err and "'bright'" in err

    documented = answers["openapi"]
    assert {path.rpartition("/")[2] for path in documented} == {
        "{y}.{format}", "{y}@2x.{format}", "tilejson.json", "legend.{format}", "map.{format}", "snapshot.{format}", "plan",
        "lines.json",
    }  # fmt: skip
    for parameter in documented.values():
        assert parameter["description"] == "How shadows shine."
        assert {"enum": ["dull", "bright"], "type": "string"} in parameter["schema"]["anyOf"]
    for name in ("tile", "snapshot"):
        assert json.loads(answers["http"][name])[0] == {"gloss": "bright"}, "the setting reaches the render process"
    assert answers["http"]["plan"][0] == {"gloss": "bright"}
    assert answers["http"]["tilejson"][0].endswith("?gloss=bright")
    for problem in answers["refusals"]:
        assert problem["status"] == 422 and problem["parameter"] == "gloss" and "'dull' or 'bright'" in problem["detail"]
    for tags in answers["tags"].values():
        assert len(set(tags)) == 2

    assert '"gloss": "bright"' in answers["pin"]
    assert "Bright gloss" in answers["words"]
    assert answers["candidate"].endswith("-bright")


def test_a_new_product_appears_in_every_interface(output):
    """The ground rises 0.75 to the east for each metre of the map. By a factor of 2 the result is 1.5 in every interface."""
    answers = output["product"]
    for interface in ("command", "python", "tile", "double tile", "map", "across blocks"):
        low, high, share = answers[interface]
        assert low == pytest.approx(1.5, abs=1e-3) and high == pytest.approx(1.5, abs=1e-3), (interface, low, high)
        assert share == 1.0, f"{interface}: a share of the values is missing"
    assert answers["colors"] == answers["wms"] == answers["seeded"], "pictures of all interfaces have the colour of 1.5"
    assert len(answers["colors"]) == 1 and answers["colors"][0][3] == 255
    assert (
        "steepness" in answers["map_layers"]
        and {"name": "steepness", "legend": True}.items() <= answers["products"]["steepness"].items()
    )
    assert answers["tilejson"]["tiles"].endswith("?layer=steepness&gain=2.0") and answers["tilejson"]["legend"] == "Steepness"
    assert answers["legend"] == ["image/png", "image/svg+xml"]
    for capabilities in ("wms capabilities", "wmts capabilities"):
        assert answers[capabilities] == [True, True], capabilities
    assert "steepness: Factor of the steepness." in answers["help"] and "--gain" in answers["help"]
    assert {path.rpartition("/")[2] for path in answers["openapi"]} == {
        "{y}.{format}", "{y}@2x.{format}", "tilejson.json", "legend.{format}", "map.{format}", "lines.json",
    }  # fmt: skip
    assert all("Factor of the steepness." in parameter["description"] for parameter in answers["openapi"].values())
    assert "| `steepness` | made-up steepness of the ground |" in answers["docs"]
    assert answers["tags"][0] != answers["tags"][1]
    for problem in answers["refusals"]:
        assert problem["status"] == 422 and problem["parameter"] == "gain", problem
    for status, _, err in answers["refused"]:
        assert status == 2 and err.count("\n") == 1 and "gain" in err, err
    status, _, err = answers["in perspective"]
    assert status == 2 and "layer: 'steepness' is not allowed. Allowed: the layers of a perspective view: color" in err


def test_a_new_parameter_reaches_picture_and_entity_tags(output):
    answers = output["parameter"]
    assert len(answers["openapi"]) == 7
    for headline in answers["http"]:
        assert json.loads(headline) == [{}, 42.0]
    assert "raised=12" in answers["tilejson"][0]
    for tags in answers["tags"].values():
        assert len(set(tags)) == 2
    assert answers["refusal"]["parameter"] == "raised"
