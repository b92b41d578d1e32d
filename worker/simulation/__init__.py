"""Kernels and batched simulation: losses, gradients, steps. Planners choose starts and schedules."""
