"""The commands of ``skugga``, one module each, which is imported when its command is used.

A module imports at its top only what its options need. Its function imports what the command needs.
"""
