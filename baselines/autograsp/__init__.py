"""Autograsp (Miller & Allen 2004): a random approach, then each joint closes until its links touch."""
