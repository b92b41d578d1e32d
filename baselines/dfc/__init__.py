"""Differentiable force closure (Liu et al. 2021) as DexGraspNet (Wang et al. 2023) optimises it: energies and MALA."""
