"""Procedural model trees, and the painter of their side view and top view.

The unit of length is the tree's height. A model tree has its foot at the origin, its tip at z = 1 and its crown within ``radius``
of the stem. It consists of strokes, straight pieces with a thickness: stem, limbs, twigs, leaves, tufts of needles. Both pictures
are orthographic views of the same strokes, so both silhouettes belong to one tree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skugga.terrain.compiled import compiled

SAMPLES_PER_TEXEL_SIDE = 3  # samples per texel and axis
COORDINATE_STEP = 2.0**-20
"""Step to which strokes are rounded, in tree heights. Sines differ in the last bit between machines, but pictures must not."""
OUTLIER_SHARES = (0.01, 0.001)  # shares of stroke ends, at the rim and at the top, that may lie outside the picture

Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Strokes:
    """Straight pieces with round ends; lengths in tree heights.

    Attributes
    ----------
    start, end
        Ends (n, 3).
    radius
        Radii (n, 2) at both ends.
    albedo
        Linear albedo (n, 3).
    """

    start: np.ndarray
    end: np.ndarray
    radius: np.ndarray
    albedo: np.ndarray


@dataclass(frozen=True)
class WhorledTree:
    """A conifer with whorls of branches on a straight stem; lengths in tree heights, slopes as rise over run.

    Attributes
    ----------
    crown_radius
        Radius of the crown.
    crown_base
        Height of the lowest whorl.
    whorl_count, branches_per_whorl
        Number of whorls, and of branches in each.
    lowest_branch_slope, highest_branch_slope
        Slopes of branches at the stem in the lowest and the highest whorl.
    branch_sag, tip_upturn
        Droop of a branch towards its tip, and rise of the tip itself.
    twig_droop
        Droop of twigs, relative to their length.
    missing_share
        Share of missing branches.
    outline_exponent
        Exponent of the outline: 1 is a cone, a lower one makes it bulge.
    twig_length, twig_spacing, twig_half_width
        Length of the longest twig, distance between twigs, and half a twig's width with needles.
    stem_radius
        Half the stem's width.
    needle_albedo, bark_albedo
        Linear albedo.
    """

    crown_radius: float
    crown_base: float
    whorl_count: int
    branches_per_whorl: int
    lowest_branch_slope: float
    highest_branch_slope: float
    branch_sag: float
    tip_upturn: float
    twig_droop: float
    missing_share: float
    outline_exponent: float
    twig_length: float
    twig_spacing: float
    twig_half_width: float
    stem_radius: float
    needle_albedo: Colour
    bark_albedo: Colour


@dataclass(frozen=True)
class ClumpedTree:
    """A tree whose limbs end in clumps of leaves or needles; lengths in tree heights.

    Attributes
    ----------
    crown_radius
        Radius of the crown.
    crown_base
        Height of the crown's base.
    widest_height
        Height of the largest width, as a share of the crown's depth from below.
    outline_exponent
        Exponent of the outline (2: an ellipse).
    clump_count, clump_radius
        Number of clumps, and their mean radius.
    min_clump_distance
        Lower bound of u in [0, 1]. The distance of a clump from the stem is u**0.6 times the largest possible one.
    clump_flatness
        Height over width of clumps.
    sprig_droop
        Droop of sprigs (bunches of leaves), relative to their horizontal distance from the clump's centre.
    sprigs_per_clump, leaves_per_sprig
        Number of sprigs (bunches of leaves) in a clump, and of leaves in a sprig.
    leaf_size
        Length and half width of a leaf.
    lowest_limb_height
        Height of the lowest limb.
    stem_radius
        Half the stem's width.
    leaf_albedo, bark_albedo, limb_albedo
        Linear albedo.
    """

    crown_radius: float
    crown_base: float
    widest_height: float
    outline_exponent: float
    clump_count: int
    clump_radius: float
    min_clump_distance: float
    clump_flatness: float
    sprig_droop: float
    sprigs_per_clump: int
    leaves_per_sprig: int
    leaf_size: tuple[float, float]
    lowest_limb_height: float
    stem_radius: float
    leaf_albedo: Colour
    bark_albedo: Colour
    limb_albedo: Colour


def paint(model: WhorledTree | ClumpedTree, seed: int, size_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Paint the side view and the top view of a model tree.

    Returns
    -------
    side, above
        float64 (size, size, 4): mean linear albedo of the visible strokes in a texel (0 without any) and their coverage of the
        texel. The side view looks north and spans the crown's width and the tree's height. The top view has east to the right
        and north up.
    """
    rng = np.random.default_rng(seed)
    grown = _grow_whorled(model, rng) if isinstance(model, WhorledTree) else _grow_clumped(model, rng)
    tree = _darken_inside(_fit_to_box(grown, model.crown_radius, size_px), model.crown_radius)
    side = _paint_view(tree, (0, 2), (1, -1.0), (-model.crown_radius, 0.0), (model.crown_radius, 1.0), size_px)
    above = _paint_view(
        tree, (0, 1), (2, 1.0), (-model.crown_radius, -model.crown_radius), (model.crown_radius, model.crown_radius), size_px
    )
    return side, above


@dataclass(frozen=True, eq=False)
class _Branches:
    """The branches of a whorled tree.

    Attributes
    ----------
    foot
        Starting points (n, 3) on the stem.
    direction
        Horizontal unit directions (n, 3).
    length, slope
        Length, and slope at the stem (n,).
    crown_depth
        Position in the crown (n,): 1 at its base, 0 at its top.
    """

    foot: np.ndarray
    direction: np.ndarray
    length: np.ndarray
    slope: np.ndarray
    crown_depth: np.ndarray


def _grow_whorled(model: WhorledTree, rng: np.random.Generator) -> Strokes:
    """Return the strokes of a conifer: stem, boughs (branches without twigs), twigs and leader (the shoot at the top)."""
    branches = _branches(model, rng)
    boughs, twigs = _boughs(model, branches), _twigs(model, branches, rng)
    shoots = rng.normal(0.0, 0.003, (7, 3)) + (0.0, 0.0, 0.03)
    leader = _needle_twigs(np.tile((0.0, 0.0, 0.965), (7, 1)), shoots, np.ones(7), model, rng)
    return _concatenate_strokes(
        _stem(model.stem_radius, 0.995, 0.0012, model.bark_albedo, model.bark_albedo, rng), boughs, twigs, leader
    )


def _branches(model: WhorledTree, rng: np.random.Generator) -> _Branches:
    """Return the branches of a conifer, from the lowest whorl to the highest."""
    whorl = np.repeat(np.arange(model.whorl_count), model.branches_per_whorl)
    whorl = whorl[rng.random(len(whorl)) >= model.missing_share]
    n = len(whorl)
    height_share = np.clip((whorl + rng.normal(0.0, 0.35, n)) / model.whorl_count, 0.0, 0.985)
    # Each whorl is rotated against the last by the golden angle, as in phyllotaxis.
    azimuth = 2.0 * np.pi * (whorl * 0.382 + (np.arange(n) + rng.normal(0.0, 0.22, n)) / model.branches_per_whorl)
    # The lowest branches are shaded, old and slightly shorter than those above them.
    outline = (1.0 - height_share) ** model.outline_exponent * np.clip(0.78 + 3.0 * height_share, 0.0, 1.0)
    return _Branches(
        foot=np.outer(model.crown_base + (1.0 - model.crown_base) * height_share, (0.0, 0.0, 1.0)),
        direction=np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(n)]),
        length=model.crown_radius * (outline * rng.uniform(0.8, 1.05, n) + 0.012),
        slope=model.lowest_branch_slope
        + (model.highest_branch_slope - model.lowest_branch_slope) * height_share
        + rng.normal(0.0, 0.06, n),
        crown_depth=1.0 - height_share,
    )


def _points_on_branches(model: WhorledTree, branches: _Branches, i: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the points (n, 3) on the branches ``i`` (n,) at the shares ``t`` (n,) of their lengths.

    ``i`` are indices into ``branches``. ``t`` is 0 at the stem and 1 at the tip.
    """
    rise = branches.slope[i] * t + branches.crown_depth[i] * (model.tip_upturn * t**4 - model.branch_sag * t**1.6)
    horizontal_offset = branches.direction[i] * t[:, None]
    return branches.foot[i] + branches.length[i, None] * (horizontal_offset + np.outer(rise, (0.0, 0.0, 1.0)))


def _boughs(model: WhorledTree, branches: _Branches) -> Strokes:
    """Return the strokes of the branches without their twigs: six pieces for each branch, thinner towards its tip."""
    pieces = 6
    i, piece = np.divmod(np.arange(len(branches.length) * pieces), pieces)
    t0, t1 = piece / pieces, (piece + 1) / pieces
    radius = (0.012 * branches.length[i] + 0.0006)[:, None] * (1.2 - np.column_stack([t0, t1]))
    return _strokes(
        _points_on_branches(model, branches, i, t0), _points_on_branches(model, branches, i, t1), radius, model.bark_albedo
    )


def _twigs(model: WhorledTree, branches: _Branches, rng: np.random.Generator) -> Strokes:
    """Return the twigs on both sides of each branch. They form a frond: longest near the stem, pointed at the tip."""
    pairs = np.maximum((branches.length / model.twig_spacing).astype(int), 2)
    i = np.repeat(np.arange(len(pairs)), 2 * pairs)
    nth = np.arange(len(i)) - np.repeat(np.cumsum(2 * pairs) - 2 * pairs, 2 * pairs)
    t = np.clip((nth // 2 + rng.random(len(i))) / pairs[i], 0.06, 1.0)
    side_sign = np.where(nth % 2 == 0, 1.0, -1.0) * rng.uniform(0.35, 1.0, len(i))
    sideways = branches.direction[i][:, [1, 0, 2]] * (-1.0, 1.0, 0.0)
    reach = np.minimum(model.twig_length, 0.005 + 0.45 * branches.length[i]) * rng.uniform(0.5, 1.15, len(i)) * (1.12 - 0.62 * t)
    twig = _normalized(0.75 * branches.direction[i] + side_sign[:, None] * sideways) * reach[:, None]
    twig[:, 2] -= reach * model.twig_droop * rng.uniform(0.1, 1.0, len(i)) * branches.crown_depth[i]
    # Needles near the stem are old and dull, recent ones at the tip are fresh.
    brightness = (0.4 + 0.8 * t) * rng.uniform(0.9, 1.1, len(pairs))[i]
    return _needle_twigs(_points_on_branches(model, branches, i, t), twig, brightness, model, rng)


def _needle_twigs(
    start: np.ndarray, twig: np.ndarray, brightness: np.ndarray, model: WhorledTree, rng: np.random.Generator
) -> Strokes:
    """Return twigs with needles: each a tapering stroke with three side shoots that make its edge ragged.

    ``start`` (n, 3) are the lower ends of the twigs, ``twig`` (n, 3) the vectors from there to their tips. ``brightness`` (n,) is a
    factor of the needles' albedo.
    """
    n, reach = len(start), np.linalg.norm(twig, axis=1, keepdims=True)
    half_width = model.twig_half_width * rng.uniform(0.7, 1.2, n)
    tint = _random_tints(model.needle_albedo, n, rng) * brightness[:, None]
    parts = [_strokes(start, start + twig, np.column_stack([half_width, 0.55 * half_width]), tint)]
    for position in (0.3, 0.55, 0.8):
        root = start + position * twig
        shoot = 0.38 * twig + 0.3 * reach * rng.normal(0.0, 1.0, (n, 3)) * (1.0, 1.0, 0.6)
        parts.append(_strokes(root, root + shoot, np.column_stack([0.75 * half_width, 0.4 * half_width]), tint))
    return _concatenate_strokes(*parts)


def _grow_clumped(model: ClumpedTree, rng: np.random.Generator) -> Strokes:
    """Return the strokes of a tree with clumps: stem, limbs and leaves."""
    centre, size = _clump_centres(model, rng)
    stem = _stem(model.stem_radius, 0.8, 0.2 * model.stem_radius, model.bark_albedo, model.limb_albedo, rng)
    return _concatenate_strokes(stem, _limbs(model, centre, rng), _leaves(model, centre, size, rng))


def _leaves(model: ClumpedTree, centre: np.ndarray, size: np.ndarray, rng: np.random.Generator) -> Strokes:
    """Return the strokes of the leaves in clumps with the centres ``centre`` (n, 3) and the radii ``size`` (n,)."""
    # A clump is a dome of sprigs, a sprig a bunch of leaves: three scales of raggedness.
    clump = np.repeat(np.arange(len(centre)), model.sprigs_per_clump)
    direction = _normalized(rng.normal(0.0, 1.0, (len(clump), 3)) + (0.0, 0.0, 0.35))
    outward = direction * (rng.uniform(0.5, 1.0, len(clump)) * size[clump])[:, None] * (1.0, 1.0, model.clump_flatness)
    sprig = centre[clump] + outward
    sprig[:, 2] -= model.sprig_droop * np.hypot(outward[:, 0], outward[:, 1])
    # The underside of a clump is in its own shade.
    shade = (0.74 + 0.52 * direction[:, 2:]) * rng.uniform(0.92, 1.08, (len(clump), 1))
    tint = _random_tints(model.leaf_albedo, len(centre), rng)[clump] * shade

    leaf = np.repeat(np.arange(len(clump)), model.leaves_per_sprig)
    scatter = 0.14 * size[clump[leaf]][:, None] * (1.0, 1.0, 0.55 + 0.6 * model.sprig_droop)
    base = sprig[leaf] + rng.normal(0.0, 1.0, (len(leaf), 3)) * scatter
    blade = _normalized(rng.normal(0.0, 0.6, (len(leaf), 3)) + direction[leaf] + (0.0, 0.0, -0.9 * model.sprig_droop))
    long, wide = np.outer(rng.uniform(0.6, 1.25, len(leaf)), model.leaf_size).T
    albedo = tint[leaf] * rng.uniform(0.87, 1.13, (len(leaf), 1))
    return _strokes(base, base + blade * long[:, None], np.column_stack([wide, 0.5 * wide]), albedo)


def _clump_centres(model: ClumpedTree, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return centres (n, 3) and radii (n,) of clumps, distributed by Mitchell's best candidate algorithm (1991)."""
    centre = np.empty((model.clump_count, 3))
    size = model.clump_radius * rng.uniform(0.7, 1.25, model.clump_count)
    for i in range(model.clump_count):
        tries = 14
        share = rng.random(tries)
        relative_height = (share - model.widest_height) / np.where(
            share < model.widest_height, model.widest_height, 1.0 - model.widest_height
        )
        outline = (1.0 - np.abs(relative_height) ** model.outline_exponent) ** (1.0 / model.outline_exponent)
        stem_distance = rng.uniform(model.min_clump_distance, 1.0, tries) ** 0.6 * np.maximum(
            model.crown_radius * outline - 0.85 * size[i], 0.0
        )
        azimuth = rng.uniform(0.0, 2.0 * np.pi, tries)
        lowest_z, highest_z = model.crown_base + 0.6 * size[i] * model.clump_flatness, 1.0 - 0.95 * size[i] * model.clump_flatness
        candidates = np.column_stack(
            [stem_distance * np.cos(azimuth), stem_distance * np.sin(azimuth), lowest_z + (highest_z - lowest_z) * share]
        )
        clearance = np.linalg.norm(candidates[:, None] - centre[None, :i], axis=2).min(axis=1, initial=np.inf)
        centre[i] = candidates[np.argmax(np.where(np.isinf(clearance), candidates[:, 2], clearance))]
    return centre, size


def _limbs(model: ClumpedTree, centre: np.ndarray, rng: np.random.Generator) -> Strokes:
    """Return limbs from the stem to the clumps with the centres ``centre`` (n, 3).

    Beginning with the innermost clump, each one joins the nearest limb or the stem.
    """
    height = np.linspace(model.lowest_limb_height, 0.8, 24)
    nodes = np.column_stack([np.zeros((24, 2)), height])
    radii = 0.75 * model.stem_radius * (1.0 - 0.8 * height / 0.8) + 0.1 * model.stem_radius
    start, end, radius = [], [], []
    for clump in centre[np.argsort(np.linalg.norm(centre[:, :2], axis=1))]:
        to_clump = clump - nodes
        run = np.hypot(to_clump[:, 0], to_clump[:, 1])
        cost = np.linalg.norm(to_clump, axis=1) + 1.5 * np.maximum(0.7 * run - to_clump[:, 2], 0.0)  # limbs rise
        parent = np.argmin(cost)
        t = np.linspace(0.0, 1.0, 7)[:, None]
        bend = nodes[parent] + 0.5 * to_clump[parent] + (0.12 * rng.normal(0.0, 1.0, 3) + (0.0, 0.0, -0.12)) * cost[parent]
        path = (1 - t) ** 2 * nodes[parent] + 2 * t * (1 - t) * bend + t**2 * clump
        taper = min(0.8 * radii[parent], 0.05 * cost[parent] + 0.002) * (1.0 - 0.75 * t[:, 0])
        start.append(path[:-1])
        end.append(path[1:])
        radius.append(np.column_stack([taper[:-1], taper[1:]]))
        nodes, radii = np.vstack([nodes, path[2:6]]), np.append(radii, taper[2:6])
    return _strokes(np.vstack(start), np.vstack(end), np.vstack(radius), model.limb_albedo)


def _stem(
    radius: float, top_height: float, top_radius: float, low_albedo: Colour, high_albedo: Colour, rng: np.random.Generator
) -> Strokes:
    """Return a stem of short pieces with mottled bark, flared at the foot and nearly straight above.

    ``radius`` is the stem's above the flare, ``top_radius`` that at ``top_height``, in tree heights. The bark changes from
    ``low_albedo`` to ``high_albedo`` upwards.
    """
    pieces = 80
    z = np.linspace(-0.02, top_height, pieces + 1)
    share = np.clip(z / top_height, 0.0, 1.0)
    sway = np.cumsum(rng.normal(0.0, 0.05 * radius, (pieces + 1, 2)), axis=0) * np.sin(np.pi * share)[:, None]
    path = np.column_stack([sway, z])
    radii = top_radius + (radius - top_radius) * (1.0 - share) + 0.3 * radius * np.exp(-np.maximum(z, 0.0) / 0.04)
    bark = np.array(low_albedo) + np.clip(2.0 * share - 0.6, 0.0, 1.0)[:, None] * (np.array(high_albedo) - np.array(low_albedo))
    core = _strokes(path[:-1], path[1:], np.column_stack([radii[:-1], radii[1:]]), bark[:-1])
    # Furrows and plates: short vertical strokes on the bark.
    piece, azimuth = rng.integers(0, pieces, 900), rng.uniform(0.0, 2.0 * np.pi, 900)
    foot = path[piece] + np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(900)]) * (0.97 * radii[piece])[:, None]
    plate = np.outer(rng.uniform(0.003, 0.012, 900), (0.0, 0.0, 1.0))
    shade = bark[piece] * rng.uniform(0.5, 1.25, (900, 1))
    return _concatenate_strokes(core, _strokes(foot, foot + plate, np.outer(0.09 * radii[piece], (1.0, 1.0)), shade))


def _random_tints(albedo: tuple[float, float, float], n: int, rng: np.random.Generator) -> np.ndarray:
    """Return ``n`` random tints (n, 3) of an albedo: lighter or darker, yellower or bluer."""
    warm = rng.normal(0.0, 0.035, n)
    return np.array(albedo) * np.column_stack([1.0 + warm, np.ones(n), 1.0 - warm]) * rng.uniform(0.82, 1.18, (n, 1))


def _darken_inside(tree: Strokes, radius: float) -> Strokes:
    """Darken the strokes' albedo by ambient occlusion inside the crown (Beer's law through the strokes' own density).

    A renderer that lights a flat picture has no interreflection between leaves. Without this shading a crown has no depth.
    ``radius`` is the crown's, in tree heights.
    """
    from scipy.ndimage import gaussian_filter

    cells = 48  # grid cells per axis
    midpoint = 0.5 * (tree.start + tree.end)
    shape = np.array([2.0 * radius, 2.0 * radius, 1.0])
    cell = np.clip(((midpoint / shape + (0.5, 0.5, 0.0)) * cells).astype(int), 0, cells - 1)
    silhouette = 2.0 * tree.radius.mean(axis=1) * np.linalg.norm(tree.end - tree.start, axis=1)
    cell_index = np.ravel_multi_index(tuple(cell.T), (cells,) * 3)
    area = np.bincount(cell_index, silhouette, cells**3).reshape((cells,) * 3)
    directions = [(2, True, shape[0] * shape[1], 0.36)] + [
        (axis, is_reversed, shape[0], 0.16) for axis in (0, 1) for is_reversed in (True, False)
    ]
    light = np.zeros_like(area)
    for axis, is_reversed, face, weight in directions:
        path = np.flip(np.cumsum(np.flip(area, axis), axis), axis) if is_reversed else np.cumsum(area, axis)
        light += weight * np.exp(-0.9 * gaussian_filter(path - 0.5 * area, 0.7, mode="nearest") * cells**2 / face)
    open_sky = light[tuple(cell.T)][:, None]
    # Leaves in the open are also slightly yellower than leaves in the shade.
    return replace(tree, albedo=tree.albedo * (0.36 + 1.15 * open_sky) * (1.0 + (open_sky - 0.5) * (0.14, 0.0, -0.14)))


def _fit_to_box(tree: Strokes, radius: float, size_px: int) -> Strokes:
    """Scale a tree about its stem to fill its bounding box except the border texels of a picture of ``size_px`` texels a side.

    The box extends to ``radius`` tree heights from the stem. The few outlying strokes (``OUTLIER_SHARES``) are removed.
    """
    ends, thick = np.stack([tree.start, tree.end]), tree.radius.T
    reach = np.hypot(ends[..., 0], ends[..., 1])
    rim = radius * (1.0 - 1.2 / size_px)
    top = 1.0 - 0.6 / size_px
    outer, upper = reach > 0.5 * radius, ends[..., 2] > 0.9
    wide = np.quantile((rim - thick[outer]) / reach[outer], OUTLIER_SHARES[0])
    tall = np.quantile((top - thick[upper]) / ends[upper, 2], OUTLIER_SHARES[1])
    start, end = np.round(ends * (wide, wide, tall) / COORDINATE_STEP) * COORDINATE_STEP
    is_inside = ((wide * reach + thick <= rim) & (tall * ends[..., 2] + thick <= top)).all(axis=0)
    return Strokes(
        start[is_inside],
        end[is_inside],
        np.round(tree.radius[is_inside] / COORDINATE_STEP) * COORDINATE_STEP,
        tree.albedo[is_inside],
    )


Corner = tuple[float, float]


def _paint_view(
    tree: Strokes, axes: tuple[int, int], depth: tuple[int, float], lower_left: Corner, upper_right: Corner, size_px: int
) -> np.ndarray:
    """Paint an orthographic view (size, size, 4) of a tree.

    ``axes`` are the axes to the right and up, ``depth`` the axis towards the viewer and its sign. ``lower_left`` and
    ``upper_right`` are the picture's corners.
    """
    axis_order, sign = [*axes, depth[0]], np.array([1.0, 1.0, depth[1]])
    start, end = tree.start[:, axis_order] * sign, tree.end[:, axis_order] * sign
    step = (np.array(upper_right) - np.array(lower_left)) / (size_px * SAMPLES_PER_TEXEL_SIDE)
    radius = np.maximum(tree.radius, 0.45 * SAMPLES_PER_TEXEL_SIDE * step.min())  # no stroke is thinner than a texel
    front = np.maximum(start[:, 2], end[:, 2]) + radius.max(axis=1)
    order = np.argsort(-front, kind="stable")  # front to back, so that most hidden samples are skipped
    strokes = start[order], end[order], radius[order], front[order]
    stroke_index = _nearest_strokes(*strokes, lower_left[0], lower_left[1], step[0], step[1], size_px * SAMPLES_PER_TEXEL_SIDE)
    return _texels(stroke_index, tree.albedo[order], SAMPLES_PER_TEXEL_SIDE)


@compiled
def _nearest_strokes(start, end, radius, front, left, bottom, step_x, step_y, size_px):
    """Return the index int32 (size, size) of the nearest stroke at each sample, -1 for none. Row 0 is the top.

    Strokes are sorted front to back. Coordinates are right, up and towards the viewer.

    Parameters
    ----------
    start, end, radius
        Ends (n, 3) and radii (n, 2) of the strokes.
    front
        (n,), the depth of each stroke's point nearest to the viewer.
    left, bottom
        The picture's lower left corner.
    step_x, step_y, size_px
        Width and height of a sample, and number of samples along a side.
    """
    stroke_index = np.full((size_px, size_px), -1, dtype=np.int32)
    nearest = np.full((size_px, size_px), -np.inf)
    for k in range(len(start)):
        ax, ay, az = start[k]
        dx, dy, dz = end[k] - start[k]
        r0, r1 = radius[k]
        max_radius = max(r0, r1)
        per_square = 1.0 / max(dx * dx + dy * dy, 1e-18)
        j0 = max(int((min(ax, ax + dx) - max_radius - left) / step_x), 0)
        j1 = min(int((max(ax, ax + dx) + max_radius - left) / step_x) + 1, size_px)
        i0 = max(size_px - 1 - int((max(ay, ay + dy) + max_radius - bottom) / step_y), 0)
        i1 = min(size_px - int((min(ay, ay + dy) - max_radius - bottom) / step_y), size_px)
        for i in range(i0, i1):
            y = bottom + (size_px - i - 0.5) * step_y - ay
            for j in range(j0, j1):
                if nearest[i, j] >= front[k]:
                    continue
                x = left + (j + 0.5) * step_x - ax
                t = min(max((x * dx + y * dy) * per_square, 0.0), 1.0)
                r = r0 + t * (r1 - r0)
                off_x, off_y = x - t * dx, y - t * dy
                bulge = r * r - off_x * off_x - off_y * off_y
                if bulge >= 0.0:
                    depth = az + t * dz + np.sqrt(bulge)
                    if depth > nearest[i, j]:
                        nearest[i, j] = depth
                        stroke_index[i, j] = k
    return stroke_index


@compiled
def _texels(stroke_index, albedo, samples):
    """Return the mean albedo and the coverage (size, size, 4) of each texel of ``samples`` x ``samples`` samples."""
    size = len(stroke_index) // samples
    rgba = np.zeros((size, size, 4))
    for i in range(size * samples):
        for j in range(size * samples):
            if stroke_index[i, j] >= 0:
                texel = rgba[i // samples, j // samples]
                for c in range(3):
                    texel[c] += albedo[stroke_index[i, j], c]
                texel[3] += 1.0
    for row in rgba:
        for texel in row:
            texel[:3] /= max(texel[3], 1.0)
            texel[3] /= samples * samples
    return rgba


def _strokes(start: np.ndarray, end: np.ndarray, radius: np.ndarray, albedo: Colour | np.ndarray) -> Strokes:
    """Return strokes from their ends (n, 3), their radii (n, 2) at both ends, and one albedo (3,) or one for each stroke (n, 3)."""
    return Strokes(start, end, radius, np.broadcast_to(np.asarray(albedo, dtype=np.float64), start.shape))


def _concatenate_strokes(*parts: Strokes) -> Strokes:
    """Return the strokes of all ``parts``, in order."""
    return Strokes(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("start", "end", "radius", "albedo")))


def _normalized(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (n, 3) scaled to unit length."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
