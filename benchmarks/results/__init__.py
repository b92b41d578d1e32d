"""Every figure and picture of the docs, made again by one command: `python -m benchmarks.results`."""
