"""Animations as jobs of a service: queued, drawn frame by frame, kept for a while, and dismissed if no client polls them."""
