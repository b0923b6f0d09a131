"""The ray-traced reference: algorithm `truth`, its disk cache, and error metrics of visibilities against it."""
