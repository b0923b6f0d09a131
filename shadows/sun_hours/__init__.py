"""How long the sun is seen: `sun_hours`, spells of sun in daily windows, their crossing times found between steps."""
