"""Runs the service on one machine: `graspd up`, `keeper` and `index`."""
