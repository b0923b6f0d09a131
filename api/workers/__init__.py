"""Render processes: the pool that supervises them, the jobs they receive, and the code they run. Only they use OpenGL."""
