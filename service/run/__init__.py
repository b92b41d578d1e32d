"""Operation of the service on one machine: `graspd up`, `controller` and `index`."""
