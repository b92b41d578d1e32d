"""Conversion of grasps: importers return postures in our frames; exporters write our shards."""
