"""Episodes: executed grasps of an arm or a flying hand."""
