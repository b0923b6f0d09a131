"""Shadow volumes that are rebuilt from depth maps."""
