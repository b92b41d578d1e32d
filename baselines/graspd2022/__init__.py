"""Grasp'D (Turpin et al., ECCV 2022): force-based contact on a distance grid, relaxed by contact-invariant forces."""
