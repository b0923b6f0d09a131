"""The trees as a view draws them: thinned out where they are too small to be told apart, their shade kept.

Where trees fall below a few pixels, a share k of them is drawn, evenly spread over the stand (``skugga.terrain.trees.thinning``),
and what remains is drawn larger by the root of 1/k in all directions: a stand of the same shape on a coarser scale. Light falls on
and through the two alike, from whatever direction, so that the share of the stand and its ground that lies in shadow holds; the
grain and the length of single trees' shadows do not. The same trees are seen, cast and are met by rays.

In perspective k follows the distance from the eye (not the direction of view); in a map it is one for all of a zoom.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, in_shares, internal
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.scene_objects import SceneObjects
from skugga.terrain.trees.foliage import TREE_VARIANTS, leaf_outlines
from skugga.terrain.trees.trees import Trees

ALL_TREES_PX = 6.8
"""Height in pixels from which all trees of a perspective view are drawn."""

ALL_CROWNS_PX = 1.5
"""Crown diameter in pixels from which all trees of a map are drawn."""

MIN_DRAWN_SHARE = 1.0 / 16.0
"""No stand is thinned more."""

QUAD_TRIANGLES = np.array([[4 * quad + a, 4 * quad + b, 4 * quad + c] for quad in range(3) for a, b, c in ((0, 1, 2), (0, 2, 3))])
"""The triangles (6, 3) of a tree's corners: two of each quad."""


@dataclass(frozen=True, eq=False)
class TreeInstances:
    """The trees drawn, in a frame; one row each.

    Attributes
    ----------
    number
        int64 (n,), their rows in ``Trees``.
    base_frame_m, base_height_m
        float64 (n, 3) and (n,), the feet and their heights.
    shape
        float32 (n, 4): half the width of the upright quads, half that of the level one, height, height of the level one; metres.
    turn
        float32 (n, 2): cosine and sine of the turn.
    look
        int32 (n,).
    curvature
        How much "up" leans per metre from the frame's origin.
    """

    number: np.ndarray
    base_frame_m: np.ndarray
    base_height_m: np.ndarray
    shape: np.ndarray
    turn: np.ndarray
    variant: np.ndarray
    curvature: float

    def __len__(self) -> int:
        return len(self.variant)

    def some(self, which: np.ndarray) -> TreeInstances:
        """The trees at some indices or where a mask says."""
        return TreeInstances(
            self.number[which], self.base_frame_m[which], self.base_height_m[which], self.shape[which], self.turn[which],
            self.variant[which], self.curvature,
        )  # fmt: skip

    def reaching(self, rotation: np.ndarray, translation: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Indices of the trees whose bounding spheres, in the axes ``rotation @ point + translation``, reach into bounds (3,)."""
        found = np.empty(len(self), np.bool_)
        in_shares(len(self), _reaching, self.base_frame_m, self.shape, rotation, translation, low, high, found)
        return np.flatnonzero(found)

    def in_cone(self, eye: np.ndarray, rotation: np.ndarray, tangents: np.ndarray) -> np.ndarray:
        """Indices of the trees whose bounding spheres reach into a pyramid from an eye along the third axis of ``rotation``.

        ``tangents`` are its least and greatest x / z and y / z.
        """
        found = np.empty(len(self), np.bool_)
        in_shares(len(self), _in_cone, self.base_frame_m, self.shape, eye, rotation, tangents, found)
        return np.flatnonzero(found)

    def nearest_first(self, which: np.ndarray, ahead: np.ndarray) -> np.ndarray:
        """The trees at some indices in their order along a direction (3,): what a rasteriser finds hidden it need not colour."""
        return which[np.argsort(self.base_frame_m[which] @ ahead, kind="stable")]

    def corners(self) -> np.ndarray:
        """The quads' corners (n, 3, 4, 3) float64 in the frame: two upright ones, then the level one."""
        return tree_corners(self.base_frame_m, self.shape, self.turn, self.curvature)

    def outlines(self) -> np.ndarray:
        """Corners (n, 3, k, 3) in the frame of convex polygons on the quads that hold all leaves."""
        corners, pictures = self.corners(), leaf_outlines()
        uv = pictures[2 * self.variant[:, None] + np.array([0, 0, 1])]
        right, up = (corners[:, :, end] - corners[:, :, 0] for end in (1, 3))
        return corners[:, :, :1] + uv[..., :1] * right[:, :, None] + uv[..., 1:] * up[:, :, None]


def _made_from(objects: SceneObjects, *more: object) -> tuple[object, ...]:
    """Trees stand still: they are kept while meshes move."""
    return objects.elevation, objects.trees, *more


@cached("scene", 512 * MIB, key=_made_from)
def tree_instances_in_map(objects: SceneObjects, frame: LocalFrame, pixel_m: float) -> TreeInstances | None:
    """The trees of a map, beyond its rim too; ``None`` without any. The last ones are kept."""
    trees = objects.trees
    return None if trees is None else _stand(objects, trees, frame, trees.crown_m / (pixel_m * ALL_CROWNS_PX))


def map_draws_trees(trees: Trees, pixel_m: float) -> bool:
    """Whether a map draws any of some trees, rather than thinning all of them out."""
    return bool((trees.rank < _share(trees.crown_m / (pixel_m * ALL_CROWNS_PX))).any())


@cached("scene", 512 * MIB, key=_made_from)
def tree_instances_in_perspective(
    objects: SceneObjects, frame: LocalFrame, eye_earth_m: tuple[float, float, float], focal_px: float
) -> TreeInstances | None:
    """The trees all round an eye; ``None`` without any. The last ones are kept."""
    trees = objects.trees
    if trees is None:
        return None
    size = np.empty(len(trees.rank))
    in_shares(len(size), _seen_from, trees.base_earth_m, np.array(eye_earth_m), trees.height_m * focal_px, size)
    return _stand(objects, trees, frame, size)


def _stand(objects: SceneObjects, trees: Trees, frame: LocalFrame, size: np.ndarray) -> TreeInstances:
    """``size`` is each tree's as a share of that from which all are drawn."""
    share = _share(size)
    number = np.flatnonzero(trees.rank < share)
    share = share[number]
    base = _bases(objects, frame)[number]
    half, height = trees.crown_m[number] / 2.0, trees.height_m[number]
    crown_height = np.array([variant.crown_height for variant in TREE_VARIANTS], np.float32)[trees.variant[number]]
    return TreeInstances(
        number=number,
        base_frame_m=base,
        base_height_m=objects.tree_heights_m[number],
        shape=(np.stack([half, half, height, height * crown_height], axis=1) / np.sqrt(share)[:, None]).astype(np.float32),
        turn=_turns(trees)[number],
        variant=trees.variant[number].astype(np.int32),
        curvature=objects.world.curvature,
    )


@cached("scene", 64 * MIB)
def _turns(trees: Trees) -> np.ndarray:
    """Cosines and sines (n, 2) float32 of all trees' turns."""
    turn = np.radians(trees.turn_deg.astype(np.float64))
    return np.stack([np.cos(turn), np.sin(turn)], axis=1).astype(np.float32)


@cached("scene", 256 * MIB, key=_made_from)
def _bases(objects: SceneObjects, frame: LocalFrame) -> np.ndarray:
    """The feet (n, 3) of all trees in a frame, which holds for many eyes."""
    assert objects.trees is not None
    return frame.points_from_earth(objects.trees.base_earth_m)


@compiled
def _seen_from(first, last, base, eye, height_px, out):
    """Trees' heights in pixels as shares of that from which all are drawn; ``height_px`` at the distance 1."""
    for n in range(first, last):
        x, y, z = base[n, 0] - eye[0], base[n, 1] - eye[1], base[n, 2] - eye[2]
        out[n] = height_px[n] / (max(np.sqrt(x * x + y * y + z * z), 1.0) * ALL_TREES_PX)


def _share(size: np.ndarray) -> np.ndarray:
    return np.clip(size.astype(np.float64) ** 2, MIN_DRAWN_SHARE, 1.0)


@internal
def tree_corner(base, shape, turn, curvature, quad, corner):
    """One corner (x, y, z) of one quad of a tree, and its v coordinate (u is 0 at corners 0 and 3, else 1)."""
    cosine, sine = np.float64(turn[0]), np.float64(turn[1])
    x, y = base[0] * curvature, base[1] * curvature
    scale = 1.0 / np.sqrt(1.0 + x * x + y * y)
    side = -1.0 if corner == 0 or corner == 3 else 1.0
    high = 1.0 if corner >= 2 else 0.0
    if quad == 0:
        along, across, up = side * shape[0], 0.0, high * shape[2]
    elif quad == 1:
        along, across, up = 0.0, side * shape[0], high * shape[2]
    else:
        along, across, up = side * shape[1], (2.0 * high - 1.0) * shape[1], np.float64(shape[3])
    up *= scale
    return (
        base[0] + along * cosine - across * sine + up * x,
        base[1] + along * sine + across * cosine + up * y,
        base[2] + up,
    )


@internal
def tree_radius(shape):
    """Radius of a sphere round the middle of a tree's stem that holds all of its quads."""
    across = max(shape[0], 1.4143 * shape[1])
    return np.sqrt(across * across + 0.25 * shape[2] * shape[2])


@compiled
def _reaching(first, last, base, shape, rotation, translation, low, high, found):
    for n in range(first, last):
        radius = tree_radius(shape[n])
        inside = True
        for k in range(3):
            v = (
                rotation[k, 0] * base[n, 0] + rotation[k, 1] * base[n, 1] + rotation[k, 2] * (base[n, 2] + 0.5 * shape[n, 2])
                + translation[k]
            )  # fmt: skip
            inside = inside and v + radius >= low[k] and v - radius <= high[k]
        found[n] = inside


@compiled
def _in_cone(first, last, base, shape, eye, rotation, tangents, found):
    at = np.empty(3)
    for n in range(first, last):
        radius = tree_radius(shape[n])
        for k in range(3):
            at[k] = (
                rotation[k, 0] * (base[n, 0] - eye[0]) + rotation[k, 1] * (base[n, 1] - eye[1])
                + rotation[k, 2] * (base[n, 2] + 0.5 * shape[n, 2] - eye[2])
            )  # fmt: skip
        inside = at[2] > -radius
        for axis in range(2):
            low, high = tangents[axis, 0], tangents[axis, 1]
            inside = inside and at[axis] - low * at[2] > -radius * np.sqrt(1.0 + low * low)
            inside = inside and high * at[2] - at[axis] > -radius * np.sqrt(1.0 + high * high)
        found[n] = inside


@compiled
def tree_corners(base, shape, turn, curvature):
    out = np.empty((len(base), 3, 4, 3))
    for n in range(len(base)):
        for quad in range(3):
            for corner in range(4):
                x, y, z = tree_corner(base[n], shape[n], turn[n], curvature, quad, corner)
                out[n, quad, corner, 0], out[n, quad, corner, 1], out[n, quad, corner, 2] = x, y, z
    return out
