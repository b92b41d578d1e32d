"""Access to the service: authentication, keys and quotas."""
