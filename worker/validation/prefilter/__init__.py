"""The prefilter: the standard level's test in MuJoCo Warp, many grasps at once on one device."""
