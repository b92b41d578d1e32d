"""Queue: tasks to workers; leases and events back."""
