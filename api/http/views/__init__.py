"""HTTP routes for views: snapshots, and animations as jobs."""
