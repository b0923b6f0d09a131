"""Level files: what an author writes, as validated values, and the data sets that come with Skugga."""
