"""Choose shadow algorithms and their settings: from a descriptor (facts of a view) to a ``Plan`` with reasons.

- ``select`` is the entry point. It chooses by a policy, such as fixed rules or predictions of time and error. The modules beside it
  hold the policies and their value types.
- ``planner`` turns choices of algorithms and settings into plans, and holds the fixed rules.
- ``cost`` predicts times and errors from a calibration of the device and fitted constants.
- ``measure`` draws candidates and compares them with ground truth.
"""
