"""What the service tells Prometheus: the list of series, what the keeper counts, what queue and index say now."""
