"""Warp and MuJoCo, started quietly, on the wanted device."""
