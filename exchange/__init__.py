"""Conversion of grasps: importers return postures in graspd's frames, exporters convert its shards."""
