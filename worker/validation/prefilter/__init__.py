"""The prefilter: the test of level standard in MuJoCo Warp, many grasps at once on one device."""
