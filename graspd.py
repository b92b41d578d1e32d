"""The command line: mounts the command groups of the three rooms and imports each only when it is used."""

from __future__ import annotations


def main() -> None:
    """Entry point of the `graspd` command."""
    raise SystemExit("graspd: no command yet")


if __name__ == "__main__":
    main()
