"""Expected time and error: this device's rates, calibration, and the model of errors."""
