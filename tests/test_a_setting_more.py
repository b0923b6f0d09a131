"""What a change touches, held by making it on a copy: a setting of shadows, a layer, another query parameter of a picture.

Each is added in the files that are named here and nowhere else, and found in all that users touch. ``docs/contributing.md`` has
the same numbers of files.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.api.conftest import write_level
from tests.copies import Edits, copy_with, said_in

A_SETTING: Edits = {
    "terrain/level/level.py": (
        (
            '    @field_validator("algorithm")\n',
            '    gloss: Literal["auto", "dull", "bright"] = Field(default="auto", description="How shadows shine.")\n\n'
            '    @field_validator("algorithm")\n',
        ),
    ),
}

A_LAYER: Edits = {
    "api/layers.py": (
        (
            "LAYERS: dict[str, Layer] = {\n",
            "LAYERS: dict[str, Layer] = {\n"
            '    "dusk": Layer(\n'
            '        about="gray by a layer more", suffixes=(".png", ".webp"),\n'
            "        picture=lambda part: np.where(part.there, np.minimum(400 * part.visibility, 255), 7).astype(np.uint8),\n"
            "    ),\n",
        ),
    ),
}

A_PARAMETER: Edits = {
    "api/http/parameters.py": (
        (
            "    **asked: Any,\n) -> PictureRequest:",
            '    raised: Annotated[float | None, Query(description="Degrees more.")] = None,\n'
            "    **asked: Any,\n) -> PictureRequest:",
        ),
        ("    return PictureRequest(\n        sun=sun,", "    return PictureRequest(\n        raised=raised, sun=sun,"),
    ),
    "api/workers/jobs.py": (
        (
            "    sun: SunSpec | None = None\n    style: StyleName | None = None\n",
            "    sun: SunSpec | None = None\n    raised: float | None = None\n    style: StyleName | None = None\n",
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


@pytest.fixture
def said(tmp_path: Path):
    """``said(edits, what)`` is what the probe says on a copy with those edits."""

    def say(edits: Edits, what: str) -> dict:
        return said_in(copy_with(tmp_path, edits), "tests.probe", write_level(tmp_path, "hills"), what)

    return say


def test_files_to_edit():
    """As ``docs/contributing.md`` has it; who reads the new thing comes on top."""
    assert [len(edits) for edits in (A_SETTING, A_LAYER, A_PARAMETER)] == [1, 1, 2]


def test_a_setting_more_is_everywhere(said):
    found = said(A_SETTING, "setting")

    value, refusal = found["level file"]
    assert value == "bright" and "shadows.gloss" in refusal and "'dull'" in refusal
    for name, text in found["help"].items():
        assert "--gloss" in text and "How shadows shine (dull or bright)." in text, name

    left_out = {
        "name": "gloss bright",
        "reason": "set by the request, without effect: no chosen algorithm has this setting",
    }
    (status, _, err), reasons = found["render"]
    assert status == 0 and left_out in reasons, err
    status, out, err = found["select"]
    assert status == 0 and left_out in json.loads(out)["reasons"], err
    assert left_out in found["plan of facts"]
    status, _, err = found["refused"]
    assert status == 2 and "gloss" in err and "loud" in err and "'bright'" in err

    documented = found["openapi"]
    assert {path.rpartition("/")[2] for path in documented} == {
        "{y}.{format}", "{y}@2x.{format}", "tilejson.json", "legend.{format}", "map.{format}", "snapshot.{format}", "plan",
        "lines.json",
    }  # fmt: skip
    for parameter in documented.values():
        assert parameter["description"] == "How shadows shine."
        assert {"enum": ["dull", "bright"], "type": "string"} in parameter["schema"]["anyOf"]
    for name in ("tile", "snapshot"):
        assert json.loads(found["http"][name])[0] == {"gloss": "bright"}, "it has crossed to the render process"
    assert found["http"]["plan"][0] == {"gloss": "bright"}
    assert found["http"]["tilejson"][0].endswith("?gloss=bright")
    for problem in found["refusals"]:
        assert problem["status"] == 422 and problem["parameter"] == "gloss" and "'dull' or 'bright'" in problem["detail"]
    for tags in found["tags"].values():
        assert len(set(tags)) == 2

    assert '"gloss": "bright"' in found["pin"]
    assert "Bright gloss" in found["words"]
    assert found["candidate"].endswith("-bright")


def test_a_layer_more_is_everywhere(said):
    found = said(A_LAYER, "layer")
    (status, _, err), brightest = found["render"]
    assert status == 0 and brightest == 255, err
    status, _, err = found["refused"]
    assert status == 2 and "for layer dusk: .png, .webp" in err
    assert "dusk, color, shadow" in found["help"]
    assert found["http"] == [[100]] * 4 and found["off the data"] == [7]
    assert found["refusal"]["parameter"] == "format" and "png, webp for layer dusk" in found["refusal"]["detail"]
    assert found["unknown"]["parameter"] == "layer" and "dusk" in found["unknown"]["detail"]
    assert "dusk" in found["layers"]
    for parameter in found["openapi"].values():
        assert "dusk" in parameter["schema"]["enum"] and "`dusk` is gray by a layer more" in parameter["description"]


def test_a_parameter_more_reaches_the_picture_and_its_tags(said):
    found = said(A_PARAMETER, "parameter")
    assert len(found["openapi"]) == 7
    for headline in found["http"]:
        assert json.loads(headline) == [{}, 42.0]
    assert "raised=12" in found["tilejson"][0]
    for tags in found["tags"].values():
        assert len(set(tags)) == 2
    assert found["refusal"]["parameter"] == "raised"
