"""Checks of `graspd doctor` for the service. Each check opens what it needs and returns one finding.

Checks change nothing: test writes have names of their own and are removed; an index is never created, moved aside or
filled.
"""
