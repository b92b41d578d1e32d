"""Kernels and batched simulation. Mechanics only: objectives and stopping belong to planners."""
