"""The index: SQL rows derived from the store, for fast answers of the API."""
