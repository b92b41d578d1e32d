"""Warp and MuJoCo, initialised without console output on a device."""
