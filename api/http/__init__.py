"""The HTTP service: routes, parameters, answers and problems, tile matrices, and the levels that are served."""
