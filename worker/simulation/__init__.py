"""Kernels and the batched simulation around them. Mechanics only: what to optimise and when to stop is a planner's."""
