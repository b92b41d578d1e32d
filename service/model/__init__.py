"""Domain model for all layers: types, errors, names, digests, records and pure functions."""
