"""The application and the server that runs it: connections, checks before all routes, errors, health, the viewer's page."""
