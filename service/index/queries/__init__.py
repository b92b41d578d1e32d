"""What the API and the controller ask the index."""
