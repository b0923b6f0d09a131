"""Draw candidates and compare them with ground truth: the policies `probe` and `measure`, and the accuracy report."""
