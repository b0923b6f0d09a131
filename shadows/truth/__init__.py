"""The reference: `truth`, ray by ray, kept on disk; and the metrics that say how far a visibility is from it."""
