"""Object store and its contents: assets, records, shards and their manifests."""
