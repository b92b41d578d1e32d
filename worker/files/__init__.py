"""Everything that reads or writes files of grasps: ours and those of others."""
