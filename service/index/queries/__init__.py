"""What the API and the keeper ask the index."""
