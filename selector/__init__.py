"""Choose shadow algorithms and their settings: descriptor in, ``Plan`` with reasons out.

- ``select`` is the entry point of the policies. The modules beside it hold the policies and their value types.
- ``planner`` turns choices into plans and holds the rules.
- ``cost`` predicts times and errors from a calibration and fitted constants.
- ``measure`` draws candidates and compares them with ground truth.
"""
