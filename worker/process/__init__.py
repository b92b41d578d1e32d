"""Worker process: takes tasks, renews leases, shuts down."""
