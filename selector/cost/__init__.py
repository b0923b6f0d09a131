"""Predict times and errors: calibration of the device, its rates, and the error model."""
