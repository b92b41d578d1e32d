"""Grasp'D (Turpin et al., ECCV 2022): force-based contact, relaxed by contact-invariant forces."""
