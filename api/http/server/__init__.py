"""The application and its server: connections, middleware, error handlers, health, documentation and the viewer."""
