"""The queue: tasks to workers, leases and events back."""
