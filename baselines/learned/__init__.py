"""Grasps that a network proposes from a camera's view of the object, optimised by fast_graspd."""
