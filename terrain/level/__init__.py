"""Level files, which describe a scene, as validated values; the checks of the files that they refer to; bundled data sets."""
