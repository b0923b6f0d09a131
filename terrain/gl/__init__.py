"""OpenGL: the device, its state, stencil passes, depth targets, records of draw calls. Only this folder makes raw OpenGL calls."""
