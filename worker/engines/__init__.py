"""Initialisation of Warp and MuJoCo without console output, and their devices."""
