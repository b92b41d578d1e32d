"""Grasps that a network proposes from what a camera sees of the object, made better by fast_graspd's descent."""
