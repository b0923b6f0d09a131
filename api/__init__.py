"""What users touch: the HTTP service, its render workers, and the command line."""
