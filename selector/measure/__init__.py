"""Draw candidate plans and compare them with ray-traced truth: the policies `probe` and `measure`, and the accuracy report."""
