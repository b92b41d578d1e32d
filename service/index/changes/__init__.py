"""Changes of the index, each in one transaction."""
