"""Pictures of views: snapshots, and animations as jobs."""
