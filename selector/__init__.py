"""Descriptor -> Plan: which algorithm, with which settings, and why.

Beside the folders lie the policies, from ``select`` down, and the values that
they hand on.
"""
