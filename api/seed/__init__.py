"""Draw pyramids of tiles in advance: `planning` fills the table of tasks, `running` draws them, `publishing` writes the archive."""
