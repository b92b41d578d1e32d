"""Stress tests of integrators and methods up to failure: `graspd stability`."""
