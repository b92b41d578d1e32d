"""Speed and accuracy of single settings of fast_graspd (docs/results/sweeps.md)."""
