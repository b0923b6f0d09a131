"""OpenGL: the only folder with raw calls. The device and its state, stencil passes, depth targets, programs on record."""
