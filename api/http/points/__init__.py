"""HTTP routes for the sun at points and along tracks."""
