"""Settings of perspective shadow maps from rules, and why."""

from __future__ import annotations

from shadows.plan import PerspectiveMapSettings, Reasoned
from terrain.errors import UnsupportedError
from terrain.level.level import SUN, Shadows

AUTO_SIZE = 1024
"""Texels a side, unless the level says otherwise: they go where the eye sees them, so that few do."""

NO_CHOICE = {
    "fit": ("tight", "a perspective map follows the camera, and is always fitted closely"),
    "cascades": (1, "a perspective map is one map, which is fine near the eye by itself"),
    "bias": ("receiver_plane", "a perspective map is compared on the triangle that is seen"),
    "culling": ("none", "a perspective map is drawn whole, since it needs no bias"),
}
"""What a shadow map may be asked for: the only way of a perspective one, and why."""


def perspective_map_settings(light: str, asked: Shadows) -> tuple[PerspectiveMapSettings, list[Reasoned]]:
    """Settings of a light's perspective shadow map, and the reasons for what was left to choose.

    Raises ``UnsupportedError`` for the penumbra of the sun's disc.
    """
    if asked.filter == "sun":
        reason = "texels of a perspective map are as uneven as the picture: 1, 2, 3 or 5 taps a side; shadow_map has the penumbra"
        raise UnsupportedError("filter", "sun", reason)
    who = "" if light == SUN else f"{light}: "
    reasons = [
        Reasoned(name=f"{who}{key} {getattr(asked, key)}", reason=f"left out: {why}")
        for key, (only, why) in NO_CHOICE.items()
        if getattr(asked, key) not in ("auto", only)
    ]
    size, bits, taps = asked.map_size, asked.depth_bits, asked.filter
    if size == "auto":
        size = AUTO_SIZE
        reasons.append(Reasoned(name=f"{who}map_size {size}", reason="texels are small where the eye is near: few will do"))
    if bits == "auto":
        bits = 24 if light == SUN else 32
        why = "steps grow with the distance from the eye" if light == SUN else "steps grow with the square of the lamp's distance"
        reasons.append(Reasoned(name=f"{who}depth_bits {bits}", reason=f"{why}: 16 bits would not do far away"))
    if taps == "auto":
        taps = 3
        reasons.append(Reasoned(name=f"{who}filter 3", reason="nine taps smooth the stairs of texels along shadow edges"))
    return PerspectiveMapSettings(map_size=size, depth_bits=bits, filter=taps), reasons
