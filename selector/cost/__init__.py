"""Expected time and error: the work of a step, this device's rates, calibration, and the model of errors.

May import: planner, serves.
"""
