"""The commands of ``skugga``, a module each, which is imported when its command is used.

At its top a module imports what its options are made of, and in its function what the command works with.
"""
