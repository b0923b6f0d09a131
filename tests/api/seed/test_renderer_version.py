"""The renderer's version increases whenever pictures change. Otherwise pyramids would mix old and new tiles."""

from __future__ import annotations

import hashlib
from pathlib import Path

from skugga.shadows.render import RENDERER_VERSION

GOLDEN = Path(__file__).resolve().parents[2] / "golden"

PICTURES = {
    1: "4653dc1e7c9d2b5e", **dict.fromkeys((2, 3), "4fe7c0ba9db922a4"), **dict.fromkeys((4, 5), "5a3926995049806e"),
    6: "ae2801dd4da7ca94", 7: "f3e2a8cec6bd0ae4", **dict.fromkeys((8, 9), "9344191e1e76196d"),
}  # fmt: skip
"""Digest of all golden pictures of levels, for each version of the renderer."""


def test_changed_golden_pictures_need_a_new_renderer_version():
    digest = hashlib.blake2b(digest_size=8)
    for path in sorted(path for path in GOLDEN.rglob("*.png") if not path.name.startswith("viewer-")):  # screenshots of pages
        digest.update(path.name.encode() + path.read_bytes())
    assert digest.hexdigest() == PICTURES[RENDERER_VERSION], (
        "golden pictures were changed: raise RENDERER_VERSION in shadows/render.py where the pictures of tiles are other ones, "
        "and put the new digest here"
    )
