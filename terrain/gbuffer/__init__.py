"""The geometry buffer: which triangle each pixel shows, at which point, with which normal; samples where something ends."""
