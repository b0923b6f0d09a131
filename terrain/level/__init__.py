"""Level files as validated values, and the bundled data sets."""
