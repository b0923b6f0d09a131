"""Scene and view facts on which the choice of algorithms is based: the type ``Descriptor`` and the functions that measure it."""
