"""Grasps of a file in the browser, one at a time: `graspd view`."""
