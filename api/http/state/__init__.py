"""State of a running service: levels, archives, encoded tiles, rate limits and metrics."""
