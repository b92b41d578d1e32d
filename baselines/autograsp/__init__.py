"""Autograsp (Miller & Allen 2004): a random approach; each joint closes until its links touch the
object or the hand."""
