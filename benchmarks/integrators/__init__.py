"""Failures of integrators, gradients and descents (docs/results/stability/stability.md)."""
