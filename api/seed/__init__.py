"""Pyramids of tiles drawn ahead: `planning` fills the table of tasks, `running` has them drawn, `publishing` makes the archive."""
