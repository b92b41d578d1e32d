"""Grasps proposed by a network from a camera's view of the object and optimised by fast_graspd."""
