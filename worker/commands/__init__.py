"""The commands of the engine room, one module each."""
