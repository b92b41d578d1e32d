"""Autograsp (Miller & Allen 2004): after a random approach each joint closes until a link it moves touches."""
