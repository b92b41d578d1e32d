"""Differentiable force closure (Liu et al. 2021) as in DexGraspNet (Wang et al. 2023)."""
