"""Network that proposes grasps from a depth picture, to compare sources of training data; see README."""
