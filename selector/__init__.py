"""Descriptor -> Plan: which algorithm, with which settings, and why."""
