"""The first judge: the certificate's test in MuJoCo Warp, many grasps at once on one device."""
