"""Measured against truth: probes of candidates, the policies `probe` and `measure`, and the comparison of algorithms."""
