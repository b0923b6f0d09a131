"""Animations as jobs of a service: queued, drawn frame by frame, cached for a while, and dismissed if no client polls them."""
