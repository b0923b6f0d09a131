"""Predict the times and errors of shadow algorithms: calibration of a device, its time rates, and the error model."""
