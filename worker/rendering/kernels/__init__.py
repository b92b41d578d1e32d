"""Warp kernels and functions of pictures: rays, reflected light, and the passes of a pixel."""
