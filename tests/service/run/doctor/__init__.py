"""What graspd doctor finds, against real servers."""
