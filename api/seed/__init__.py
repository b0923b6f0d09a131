"""Pyramids of tiles drawn ahead: `planning` fills the table of tasks, `running` draws them, `publishing` writes the archive."""
