"""Every change of the index, each inside one transaction."""
