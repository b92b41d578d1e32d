"""Integrators and methods driven to where they fail: `graspd stability`."""
