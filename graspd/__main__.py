"""`python -m graspd`."""

from graspd.cli import main

main()
