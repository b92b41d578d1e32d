"""Processes beside this one, for work that threads of one process cannot share out to many cores."""
