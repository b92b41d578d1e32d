"""Changes of the index, each inside one transaction."""
