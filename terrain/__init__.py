"""The world: levels, elevation, frames, the sun and the visible surface. Facts only, no decision about shadows."""
