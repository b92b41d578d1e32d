"""The object store and what is kept in it: assets, records, shards and their manifests."""
