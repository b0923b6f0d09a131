"""The line sweep: `sweep` follows lines along the sun's azimuth over the heightfield, in compiled loops without OpenGL."""
