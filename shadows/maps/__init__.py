"""Depth maps: `shadow_map` and `perspective_shadow_map`; where their maps lie, how they are drawn and looked up."""
