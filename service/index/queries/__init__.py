"""Queries of the API and the controller."""
