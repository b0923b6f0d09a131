"""Algorithm `hybrid`: a small map decides pixels where it provably can, and shadow volumes decide the others."""
