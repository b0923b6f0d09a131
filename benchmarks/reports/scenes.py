"""The scenes of the published comparisons, one of each kind, as arguments of ``skugga compare``."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

SAMPLE_DATA_PREFIX = "DATA/"
"""The prefix of a level's path for files in the folder of sample data, wherever it is."""

PERSPECTIVE_SIZE_PX = (640, 512)
"""Width and height of perspective views. At this size forty rows take minutes, and a report contains their pictures losslessly."""


@dataclass(frozen=True)
class ReportScene:
    """A scene to compare.

    Attributes
    ----------
    name, title
        Name of its report, and title in the page.
    level, view
        Name of a bundled level or a raster below ``DATA/``, and name of its view.
    size
        Width and height of the picture, pixels.
    time_limit_s
        Time limit of the comparison on two cores of its own, seconds.
    data_attribution
        Owner of the data.
    sun
        Azimuth and altitude of the sun, degrees; ``None`` uses the level's own light.
    bounds
        West, south, east and north of a map, units of its CRS.
    """

    name: str
    title: str
    level: str
    view: str
    size: tuple[int, int]
    time_limit_s: float
    data_attribution: str
    sun: tuple[float, float] | None = None
    bounds: tuple[float, float, float, float] | None = None

    @property
    def command_words(self) -> list[str]:
        """The words of the command line of the comparison."""
        words = ["skugga", "compare", self.level, "--view", self.view, "--size", "x".join(map(str, self.size))]
        if self.sun is not None:
            words += ["--azimuth", f"{self.sun[0]:g}", "--altitude", f"{self.sun[1]:g}"]
        if self.bounds is not None:
            words += ["--bounds", ",".join(f"{value:.12g}" for value in self.bounds)]
        return words

    @property
    def command(self) -> str:
        """The command line of the comparison."""
        return shlex.join(self.command_words)

    def level_path(self, data: Path) -> str:
        """Return the path of the scene's raster in the folder ``data``, or the name of its bundled level."""
        return str(data / self.level.removeprefix(SAMPLE_DATA_PREFIX)) if self.level.startswith(SAMPLE_DATA_PREFIX) else self.level


SCENES = {
    each.name: each
    for each in (
        ReportScene(
            "mountain", "Mountains, as a map: relief alone, low sun", "jacksboro", "map", (512, 512), 100.0,
            "Elevation: SRTM, NASA (sample data of matplotlib)", sun=(237.0, 6.0),
            bounds=(735000.0, 4008300.0, 760600.0, 4033900.0),
        ),
        ReportScene(
            "village", "A village, its woods and the ridges behind it", "jacksboro_wooded", "village", PERSPECTIVE_SIZE_PX, 180.0,
            "Elevation: SRTM, NASA (sample data of matplotlib); woods and houses made up",
        ),
        ReportScene(
            "city", "A town by laser scan, as a map: roofs and crowns are its relief",
            "DATA/urban/essen_dom1_32_356_5699_1_nw_2020.tif", "map", (400, 400), 220.0,
            "Geobasis NRW, surface model DOM1, tile 32356_5699, 2020, dl-de/zero-2-0", sun=(230.0, 30.0),
            bounds=(356380.0, 5699360.0, 356780.0, 5699760.0),
        ),
        ReportScene(
            "lamp", "A room half under a lattice, a spot lamp through it", "thesis_room", "main", PERSPECTIVE_SIZE_PX, 100.0,
            "Scene after J. Sindholt (DTU 2005); geometry made by Skugga",
        ),
        ReportScene(
            "rocks", "Stone circles of a thesis under the sun", "thesis_rocks_sun", "main", PERSPECTIVE_SIZE_PX, 100.0,
            "Scene after J. Sindholt (DTU 2005); geometry made by Skugga",
        ),
    )
}  # fmt: skip
