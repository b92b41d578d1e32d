"""Who asks, and how much of the service is theirs: keys, quotas."""
