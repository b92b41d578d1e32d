"""Checks of `graspd doctor` for the service; each check returns one finding.

Checks change nothing: test objects have own names and are removed; no check creates, moves or fills an index.
"""
