"""Read the vertical axis of a raster: the unit of its numbers, and whether they grow upwards or downwards.

A band may state a unit and a direction. So does a vertical CRS (the third axis of a compound or three-dimensional CRS). Heights
grow upwards, depths downwards. The settings of the level file take precedence over the band, and the band over the CRS.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import rasterio
from pyproj import CRS
from pyproj.exceptions import CRSError
from rasterio.errors import RasterioError

from skugga.terrain.errors import SourceError
from skugga.terrain.level.level_source import option_remedy
from skugga.terrain.level.parts import METRES_PER_UNIT, Positive, Units

_UNIT_SYNONYMS: dict[Units, str] = {
    "m": "m metre meter metres meters mtr masl mamsl",
    "ft": "ft foot feet fti ftint intft internationalfoot internationalfeet footinternational footint",
    "us-ft": (
        "usft ftus footus feetus usfoot usfeet ussurveyfoot ussurveyfeet ussurveyft surveyfoot surveyfeet surveyft "
        "footussurvey feetussurvey ftussurvey footsurveyus"
    ),
    "dm": "dm decimetre decimeter decimetres decimeters",
    "cm": "cm centimetre centimeter centimetres centimeters",
    "mm": "mm millimetre millimeter millimetres millimeters",
    "km": "km kilometre kilometer kilometres kilometers",
    "yd": "yd yds ydi yard yards",
    "fathom": "fathom fathoms fath fth fthi ftm fm",
}
UNIT_WORDS: dict[str, Units] = {word: unit for unit, words in _UNIT_SYNONYMS.items() for word in words.split()}
"""Names of units in files, in lower case and without other signs."""

NO_UNIT_WORDS = ("", "1", "unknown", "undefined", "unspecified", "unitless", "none", "na")
"""Words in files that state no unit."""

FOOT_MARKS = ("'", "\N{PRIME}", "\N{RIGHT SINGLE QUOTATION MARK}")

_UNKNOWN_UNIT_SIGNS = " \t-_./?*"
"""Signs that stand for an unknown unit."""

_DATUM_SUFFIX = re.compile(r"\s*(\(.*\)|\[.*\]|a\.?m?\.?s\.?l\.?|above\b.*)\s*$", re.IGNORECASE)
_UNIT_RELATIVE_TOLERANCE = 1e-7
"""Relative tolerance within which units are equal: a foot and a US survey foot differ by 2e-6."""

_DEPTH_NAME_PREFIXES = ("depth", "sea_floor_depth")
"""Prefixes of CF standard names of depths."""


@dataclass(frozen=True)
class VerticalAxis:
    """The vertical axis of a raster: unit and direction of its stored numbers.

    Attributes
    ----------
    unit
        A name in ``METRES_PER_UNIT``, or the unit's length as text.
    unit_m
        Length of the unit, metres.
    unit_source, positive_source
        Sources of the unit and the direction, in words; ``None`` if not stated.
    positive
        Whether numbers grow upwards or downwards.
    conflicting_unit
        A conflicting unit that the raster also states, in words.
    """

    unit: str
    unit_m: float
    unit_source: str | None
    positive: Positive
    positive_source: str | None
    conflicting_unit: str | None = None

    @property
    def metres_per_stored_unit(self) -> float:
        """Change of height, in metres upwards, per 1 in the stored numbers; negative for depths."""
        return self.unit_m if self.positive == "up" else -self.unit_m

    @property
    def statement(self) -> str:
        """Unit and direction with their sources, as a phrase."""
        unit = f"heights in {self.unit} ({self.unit_source or 'no unit is stated'})"
        return f"{unit}, positive {self.positive} ({self.positive_source or 'no direction is stated'})"


def vertical_axis(
    source: str, dataset: rasterio.DatasetReader, units: Units | None = None, positive: Positive | None = None
) -> VerticalAxis:
    """Return the vertical axis of an open raster's first band; ``units`` and ``positive`` are a level file's settings.

    Raises ``SourceError`` for an unknown unit or direction of the band.
    """
    try:
        crs = None if dataset.crs is None else CRS.from_user_input(dataset.crs.to_wkt())
    except (CRSError, RasterioError):  # callers that need the CRS raise an error
        crs = None
    return axis_of_band(source, dataset.units[0] or "", dataset.tags(1), crs, units, positive)


def axis_of_band(
    source: str,
    unit_word: str,
    tags: Mapping[str, object],
    crs: CRS | None,
    units: Units | None = None,
    positive: Positive | None = None,
) -> VerticalAxis:
    """Return the vertical axis of a band from its unit in words (``""`` for none), its CF tags and its CRS.

    ``units`` and ``positive`` are a level file's settings. Raises ``SourceError`` for an unknown unit or direction.
    """
    of_crs = _axis_of_crs(crs)
    from_setting = None if units is None else (units, METRES_PER_UNIT[units], "by terrain.units")
    band_unit = _unit_of_band(source, unit_word, of_crs.unit_name) if units is None else None
    from_band = None if band_unit is None else (band_unit, METRES_PER_UNIT[band_unit], "by its band")
    from_crs = None if of_crs.unit_m is None else (_unit_name(of_crs.unit_m), of_crs.unit_m, of_crs.source_text)
    name, unit_m, unit_from = from_setting or from_band or from_crs or ("m", 1.0, None)
    differs = from_band is not None and from_crs is not None and abs(from_crs[1] / unit_m - 1.0) > _UNIT_RELATIVE_TOLERANCE
    directions: list[tuple[Positive | None, str | None]]
    directions = [
        (positive, "by terrain.positive"),
        (_positive_of_band(source, tags) if positive is None else None, "by its band"),
        (of_crs.positive, of_crs.source_text),
    ]
    direction, positive_from = next(
        ((candidate, source_text) for candidate, source_text in directions if candidate is not None), ("up", None)
    )
    conflict = f"in {from_crs[0]} {of_crs.source_text}" if from_crs is not None and differs else None
    return VerticalAxis(name, unit_m, unit_from, "down" if direction == "down" else "up", positive_from, conflict)


@dataclass(frozen=True)
class _CrsAxis:
    """The third axis of a CRS.

    Attributes
    ----------
    unit_name
        Name of its unit; ``None`` if the CRS has no third axis.
    unit_m
        Length of the unit, metres.
    positive
        Direction in which it grows.
    source_text
        The CRS as a source, in words.
    """

    unit_name: str | None = None
    unit_m: float | None = None
    positive: Positive | None = None
    source_text: str = ""


def _axis_of_crs(crs: CRS | None) -> _CrsAxis:
    """Return the third axis of a CRS; all fields are empty if there is no CRS or no third axis."""
    if crs is None or len(crs.axis_info) != 3:
        return _CrsAxis()
    axis, parts = crs.axis_info[2], crs.sub_crs_list
    positive: Positive | None = "down" if axis.direction == "down" else "up" if axis.direction == "up" else None
    unit_m = float(axis.unit_conversion_factor or 1.0)
    return _CrsAxis(axis.unit_name, unit_m, positive, f"by its CRS '{parts[-1].name if parts else crs.name}'")


def unit_of_band(source: str, dataset: rasterio.DatasetReader) -> Units | None:
    """Return the unit that a raster's first band states, or ``None``. Raises ``SourceError`` for an unknown unit."""
    return _unit_of_band(source, dataset.units[0] or "", None)


def _unit_of_band(source: str, word: str, crs_word: str | None) -> Units | None:
    """Return the unit that a word means; ``None`` for a word that states no unit, or that repeats the CRS's unit.

    GDAL gives a band the unit name of its CRS, which may be unknown here. Raises ``SourceError`` for any other unknown word.
    """
    unit = unit_of_word(word)
    if unit is None and not _states_no_unit(word) and word != crs_word:
        advice = f"Use one of {', '.join(METRES_PER_UNIT)} or their long names; for ground, {option_remedy('units', 'UNIT')}"
        raise SourceError(source, f"the unit {word} of its band is unknown", advice)
    return unit


def unit_of_word(word: str) -> Units | None:
    """Return the unit that a word in a file means; ``None`` for an unknown word."""
    if word.strip() in FOOT_MARKS:
        return "ft"
    return next((UNIT_WORDS[plain] for plain in _normalized_words(word) if plain in UNIT_WORDS), None)


def _states_no_unit(word: str) -> bool:
    """Return whether a word in a file means that the unit is not stated."""
    plain = _normalized_words(word)[0]
    return plain in NO_UNIT_WORDS if plain else not word.strip(_UNKNOWN_UNIT_SIGNS)


def _normalized_words(word: str) -> tuple[str, str]:
    """Return the lower-case letters and digits of a unit's word, with and without a suffix that names the heights' datum."""
    with_datum, without_datum = (re.sub(r"[\W_]+", "", text).casefold() for text in (word, _DATUM_SUFFIX.sub("", word)))
    return with_datum, without_datum


def _unit_name(unit_m: float) -> str:
    """Return the name of a unit of the given length, or the length as text."""
    return next(
        (name for name, metres in METRES_PER_UNIT.items() if abs(unit_m / metres - 1.0) <= _UNIT_RELATIVE_TOLERANCE),
        f"{unit_m:.9g} m",
    )


def positive_word(tags: Mapping[str, object]) -> str | None:
    """Return the word of the CF tag ``positive`` in lower case; ``None`` if it is missing or empty."""
    word = tags.get("positive")
    return None if word is None else str(word).strip().lower() or None


def _positive_of_band(source: str, tags: Mapping[str, object]) -> Positive | None:
    """Return the direction in which the numbers of a band with these CF tags grow; ``None`` if they state none.

    Raises ``SourceError`` for an unknown direction. ``source`` is the file's name, for the message.
    """
    word = positive_word(tags)
    if word in ("up", "down"):
        return "down" if word == "down" else "up"
    if word is not None:
        advice = f"If its numbers are heights, {option_remedy('positive', 'up')}; if they are depths, down"
        raise SourceError(source, f"the direction {word} of its band is unknown", advice)
    return "down" if str(tags.get("standard_name", "")).startswith(_DEPTH_NAME_PREFIXES) else None
