"""One worker: takes tasks, renews leases, ends as it should."""
