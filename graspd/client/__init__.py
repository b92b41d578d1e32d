"""The service over HTTP: the client, and the commands that talk through it."""
