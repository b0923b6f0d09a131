"""The sun at points and along tracks."""
