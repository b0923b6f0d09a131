"""The line sweep: `sweep`, lines along the sun's azimuth over the heightfield. Compiled loops, no OpenGL."""
