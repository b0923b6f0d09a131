"""Descriptor -> Plan: which algorithm, with which settings, and why.

May import the floors ``shadows`` and ``terrain``. Beside the rooms lie the policies, from ``select`` down, and the values that
they hand on.
"""
