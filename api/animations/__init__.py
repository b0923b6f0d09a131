"""Animations as jobs of a service: asked for, drawn frame by frame, kept for a while, and stopped where nobody asks any more."""
