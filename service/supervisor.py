"""`graspd up`: Redis, API, keeper and workers as child processes of one parent."""

from __future__ import annotations

from service.settings import Settings


class Supervisor:
    """Starts the whole service on this machine, keeps it alive, stops it cleanly. Usable as a context manager."""

    def __init__(self, settings: Settings, *, workers: int = 1, api: bool = True) -> None:
        """`settings.port` 0 picks a free port."""
        raise NotImplementedError

    @property
    def api_url(self) -> str:
        """Where the API answers, e.g. http://127.0.0.1:8000."""
        raise NotImplementedError

    def start(self) -> None:
        """Take the data folder and start the children; does not wait for them.

        Raises:
            BusyError: another graspd owns the data folder (its pid is named), or the port is taken.
        """
        raise NotImplementedError

    def wait_ready(self, timeout: float) -> None:
        """Until Redis, keeper, a worker and the API answer; UnavailableError names what did not, and its log."""
        raise NotImplementedError

    def stop(self) -> None:
        """Stop all children, the workers first and Redis last. Idempotent."""
        raise NotImplementedError
