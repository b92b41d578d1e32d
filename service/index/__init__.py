"""The index: SQL rows derived from the store, made to answer the API fast."""
