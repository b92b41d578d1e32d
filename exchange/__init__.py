"""Grasps to and from the formats of others. An importer gives postures in our frames; an exporter writes our shards."""
