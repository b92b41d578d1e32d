"""Commands for planning, validation, files and workers."""
