"""What a request passes before a route is asked."""
