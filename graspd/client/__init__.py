"""Client of the service over HTTP, and the commands that use it."""
