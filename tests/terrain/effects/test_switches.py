"""Effects that draw no part of the picture themselves: each switch names the file that implements it."""

from __future__ import annotations

import re
from pathlib import Path

from skugga.terrain.effects import EFFECTS, SWITCHES

ROOT = Path(__file__).resolve().parents[3]


def test_effects_without_a_part_are_switches():
    assert set(SWITCHES) == {name for name, effect in EFFECTS.items() if effect.apply is None}
    assert all((effect.apply is None) == (effect.stage is None) for effect in EFFECTS.values())


def test_the_file_that_a_switch_names_mentions_the_switch():
    for name, description in SWITCHES.items():
        file_match = re.search(r"\((\S+\.py)\)$", description)
        assert file_match is not None, name
        assert f'"{name}"' in (ROOT / file_match[1]).read_text(encoding="utf-8"), name
