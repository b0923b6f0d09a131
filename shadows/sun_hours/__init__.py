"""Hours of sun: `sun_hours` computes the intervals of direct sun at the cells of a map, within a window of time of each day."""
