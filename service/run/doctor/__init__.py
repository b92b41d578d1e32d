"""What `graspd doctor` looks at in the shared room. Each check opens what it needs and gives one finding.

Nothing is changed: writes are probes under names of their own, which are removed again, and an index is never made,
moved aside or filled.
"""
