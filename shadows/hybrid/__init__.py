"""The hybrid: `hybrid`, a small map that decides where it provably can, and volumes where it cannot."""
