"""Tree variants and crown diameters, drawn from the hashes of the trees' positions."""

from __future__ import annotations

import numpy as np

from skugga.terrain.level.parts import Species
from skugga.terrain.trees.foliage import TREE_VARIANTS
from skugga.terrain.trees.scatter import uniform_numbers

HEIGHT_STREAM, CROWN_STREAM, SPECIES_STREAM, VARIANT_STREAM, YAW_STREAM, SPREAD_STREAM = range(6)
"""Numbers of independent random sequences, one per property (``skugga.terrain.trees.scatter.uniform_numbers``)."""

CROWN_DIAMETER_LINES: dict[str, tuple[float, float]] = {"conifer": (1.0, 0.2), "broadleaf": (1.0, 0.3)}
"""Usual crown diameter: metres, and metres per metre of height.

The lines approximate the curves of S. C. Popescu, R. H. Wynne (Seeing the trees in the forest, 2004) for pines and deciduous trees
of 8 to 25 m. The curves themselves give saplings crowns wider than high.
"""

MAX_CROWN_DEVIATION_SHARE = 0.15
"""Maximum relative deviation of a crown's diameter from the usual one."""


def random_variants(key: np.ndarray, species: Species) -> np.ndarray:
    """Return random variants uint8 (n,) of a species, indices into ``TREE_VARIANTS``. Half of a ``mixed`` stand are conifers."""
    kinds = {
        kind: np.array([n for n, variant in enumerate(TREE_VARIANTS) if variant.species == kind], np.uint8)
        for kind in CROWN_DIAMETER_LINES
    }
    share = uniform_numbers(key, VARIANT_STREAM)
    variants_by_kind = {kind: candidates[(share * len(candidates)).astype(int)] for kind, candidates in kinds.items()}
    if species != "mixed":
        return variants_by_kind[species]
    return np.where(uniform_numbers(key, SPECIES_STREAM) < 0.5, variants_by_kind["conifer"], variants_by_kind["broadleaf"])


def species_line(lines: dict[str, tuple[float, float]], species: Species) -> tuple[float, float]:
    """Return the line of a species: metres, and metres per metre of height.

    ``lines`` has such a line for each species. ``mixed`` gets the mean of both.
    """
    of_species = list(lines.values()) if species == "mixed" else [lines[species]]
    base, slope = np.mean(of_species, axis=0).tolist()
    return base, slope


def random_crown_diameters_m(height_m: np.ndarray, variant: np.ndarray, deviation_share: np.ndarray) -> np.ndarray:
    """Return crown diameters float64 (n,), metres.

    A diameter is the usual one of the species for the height, times two factors. The first is the variant's ratio of crown to
    height, relative to the species' mean. The second is a random deviation by ``deviation_share`` (n,) in [0, 1).
    """
    mean_ratio = {kind: np.mean([k.crown_to_height for k in TREE_VARIANTS if k.species == kind]) for kind in CROWN_DIAMETER_LINES}
    base, slope, width_ratio = np.array(
        [(*CROWN_DIAMETER_LINES[k.species], k.crown_to_height / mean_ratio[k.species]) for k in TREE_VARIANTS]
    ).T[:, variant]
    return (base + slope * height_m) * width_ratio * (1.0 + MAX_CROWN_DEVIATION_SHARE * (2.0 * deviation_share - 1.0))
