"""Hours of sun: `sun_hours`, intervals of direct sun in daily windows, with their ends located between time steps."""
