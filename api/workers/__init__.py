"""Render processes: the pool before them, the jobs they are sent, and what a process does. No OpenGL outside of them."""
