"""How trees look and how wide their crowns are, drawn from the hashes of their places."""

from __future__ import annotations

import numpy as np

from skugga.terrain.level.parts import Species
from skugga.terrain.trees.foliage import TREE_VARIANTS
from skugga.terrain.trees.scatter import shares

HEIGHT, CROWN, SPECIES, LOOK, TURN, SPREAD = range(6)
"""Streams of shares."""

CROWN_M: dict[str, tuple[float, float]] = {"conifer": (1.0, 0.2), "broadleaf": (1.0, 0.3)}
"""Crown's diameter: metres, and metres per metre of height. Lines along the curves of S. C. Popescu, R. H. Wynne (Seeing the
trees in the forest, 2004) for pines and deciduous trees of 8 to 25 m, which give saplings crowns wider than high."""

CROWN_SPREAD = 0.15
"""How far single crowns lie from the line, as a share of it."""


def looks_of(key: np.ndarray, species: Species) -> np.ndarray:
    """Looks uint8 (n,) of a species; of ``mixed`` stands half the trees are conifers."""
    kinds = {
        kind: np.array([n for n, variant in enumerate(TREE_VARIANTS) if variant.species == kind], np.uint8) for kind in CROWN_M
    }
    share = shares(key, LOOK)
    drawn = {kind: looks[(share * len(looks)).astype(int)] for kind, looks in kinds.items()}
    if species != "mixed":
        return drawn[species]
    return np.where(shares(key, SPECIES) < 0.5, drawn["conifer"], drawn["broadleaf"])


def line_of(lines: dict[str, tuple[float, float]], species: Species) -> tuple[float, float]:
    """Metres, and metres per metre of height, for a species (``mixed``: between both)."""
    of_species = list(lines.values()) if species == "mixed" else [lines[species]]
    base, slope = np.mean(of_species, axis=0).tolist()
    return base, slope


def own_crown_m(height_m: np.ndarray, variant: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Diameters of single crowns: their species' usual ones, wider or narrower as the look is among its kin."""
    mean_ratio = {kind: np.mean([k.crown_to_height for k in TREE_VARIANTS if k.species == kind]) for kind in CROWN_M}
    base, slope, wide = np.array([(*CROWN_M[k.species], k.crown_to_height / mean_ratio[k.species]) for k in TREE_VARIANTS]).T[
        :, variant
    ]
    return (base + slope * height_m) * wide * (1.0 + CROWN_SPREAD * (2.0 * share - 1.0))
