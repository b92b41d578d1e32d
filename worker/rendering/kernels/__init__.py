"""Warp kernels and functions of the pictures: rays, what surfaces send back, and what a pixel makes of both."""
