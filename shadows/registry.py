"""The shadow algorithms and what they can do, as data: what one cannot serve is listed with the sentence that says why."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from shadows import planar
from shadows.hybrid import hybrid
from shadows.maps import perspective_shadow_map, shadow_map
from shadows.passes import PassLayer
from shadows.sweep import sweep
from shadows.truth import truth
from shadows.volumes import shadow_volume
from terrain.level.level import AlgorithmName, CasterKind

ViewKind = Literal["map", "bent map", "perspective"]
"""``bent map``: one that no camera can see as it is, for the earth and its projection bend it."""

LightKind = Literal["sun", "spot", "omni"]
GroundKind = Literal["level", "uneven"]
"""``level`` is one plane: without relief, in a flat world."""

Part = ViewKind | LightKind | CasterKind | GroundKind
"""A part of what is asked of an algorithm: a view, a light, a kind of casters, a ground."""


@dataclass(frozen=True)
class Algorithm:
    """An algorithm's name, the passes it runs for each light, a sentence about it, and why it refuses what it does."""

    name: AlgorithmName
    passes: tuple[str, ...]
    about: str
    refuses: Mapping[Part, str] = field(default_factory=dict)
    """What it cannot serve -> why; it serves everything else."""
    layers: tuple[PassLayer, ...] = ()
    """Intermediate pictures that it leaves behind when they are asked for."""
    served: bool = True
    """Whether a request over HTTP may ask for it."""

    def refusal(self, parts: Iterable[Part]) -> str | None:
        """Why it cannot serve all of these together; ``None`` if it can."""
        return next((self.refuses[part] for part in parts if part in self.refuses), None)


_NO_VOLUME: dict[Part, str] = {
    "forest": "a volume is made of edges and knows no texture: alpha-tested leaves would cast the whole of their quads",
    "bent map": "it draws in the view itself, and at this scale the map bends by more than a quarter of a pixel off any camera",
}

ALGORITHMS: dict[AlgorithmName, Algorithm] = {
    "shadow_map": Algorithm(
        "shadow_map", shadow_map.PASSES, "depth map from the light, which follows what is looked at", layers=("shadow-map",),
    ),
    "perspective_shadow_map": Algorithm(
        "perspective_shadow_map", perspective_shadow_map.PASSES, "a map in the space of the picture: fine near the eye",
        {
            "map": "a map has no perspective that it could follow",
            "omni": "what shines all round has no one map in post-perspective space",
        },
        layers=("shadow-map",),
    ),
    "shadow_volume": Algorithm(
        "shadow_volume", shadow_volume.PASSES, "volumes of shadow counted in the stencil: exact to the pixel", _NO_VOLUME,
        layers=("stencil", "silhouettes", "volumes"),
    ),
    "hybrid": Algorithm(
        "hybrid", hybrid.PASSES, "a small map, and shadow volumes only where it cannot decide", _NO_VOLUME,
        layers=("shadow-map", "stencil", "silhouettes", "volumes"),
    ),
    "planar": Algorithm(
        "planar", planar.PASSES, "casters projected onto level ground through the stencil; they throw no shadow on one another",
        {"uneven": "it projects onto one plane, and the ground of this level is not flat"}, layers=("stencil",),
    ),
    "sweep": Algorithm(
        "sweep", sweep.PASSES, "lines along the sun's azimuth over the heightfield, good at every azimuth; needs no OpenGL",
        {
            "spot": "its lines run along the one azimuth of the sun: a lamp's rays spread",
            "omni": "its lines run along the one azimuth of the sun: a lamp's rays spread",
            "meshes": "it knows one height per place, and a mesh may have several above each other",
            "forest": "a tree is no heightfield: light passes under its crown and between its leaves",
        },
        layers=("shadow-height",),
    ),
    "truth": Algorithm("truth", truth.PASSES, "rays: the reference, not for real time", served=False),
    "none": Algorithm("none", (), "no cast shadows"),
}  # fmt: skip


def able(parts: Iterable[Part]) -> list[AlgorithmName]:
    """The algorithms that throw shadows and can serve all of these together, but for the reference."""
    parts = tuple(parts)
    return [name for name, each in ALGORITHMS.items() if each.passes and each.served and each.refusal(parts) is None]
