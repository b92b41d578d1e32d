"""`graspd up`: Redis, API, controller and workers as child processes of one parent."""

import json
import logging
import secrets
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import IO, Final, Self

import httpx
from pydantic import SecretStr

from graspd.service.model.errors import GraspdError, UnavailableError
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.identity import identify_if_redis_answers, recorded_service
from graspd.service.pipeline.leading import PART
from graspd.service.queue.connection import redis_url
from graspd.service.queue.rq_queue import RqQueue, open_queue
from graspd.service.run.address import ListenAddress, bind_socket, forget_address, local_url, record_address
from graspd.service.run.children import Child, keep_alive, kill_leftovers, stop_children
from graspd.service.run.embedded import find_server, lock_file, lock_redis, move_broken_log, move_log, server_command
from graspd.service.settings import Settings
from graspd.service.store.store import open_store

log = logging.getLogger(__name__)
_PROBE_S: Final = 0.1
#: Timeout [s] for readiness: kernels compile at first use, perhaps on a busy machine.
READY_S: Final = 1800.0
_TOLD_EVERY_S: Final = 15.0
#: Number of restarts after which a process counts as failed.
_ENDS: Final = 5
_REDIS_S: Final = 60.0
_PROGRAM: Final = (sys.executable, "-m", "graspd")


class Supervisor:
    """Context manager of the service on this machine, which starts, restarts and stops its processes."""

    def __init__(
        self,
        settings: Settings,
        *,
        workers: int = 1,
        api: bool = True,
        worker_command: Sequence[str] = (*_PROGRAM, "worker"),
        joining: ListenAddress | None = None,
    ) -> None:
        """`settings.port` 0 selects a free port; `joining` admits workers of other machines."""
        self._wanted, self._workers, self._api = settings, workers, api
        self._worker_command, self._joining = tuple(worker_command), joining
        self._locks: list[IO[str] | socket.socket] = []
        self._children: list[Child] = []
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self.settings = settings
        """Settings with absolute data folder and resolved port."""

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def api_url(self) -> str:
        return local_url(self.settings.host, self.settings.port)

    @property
    def pids(self) -> dict[str, int]:
        return {child.name: child.process.pid for child in list(self._children) if child.process is not None}

    def start(self) -> None:
        """Lock the data folder and start the children; do not wait until they are ready.

        BusyError: another graspd owns the data folder (with its pid), or the port is in use.
        """
        self._stopping.clear()
        folder = self._wanted.data_dir.resolve()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UnavailableError(f"the data folder {folder} cannot be made: {error.strerror}") from None
        try:
            self._locks = [lock_file(folder / "lock", f"the data folder {self._wanted.data_dir}")]
            if leftovers := kill_leftovers(folder):
                log.warning("ended %d processes that an earlier graspd left behind", len(leftovers))
            self._resolve_settings()
            self._check_identity(folder)
            self._children = self._create_children()
            self._record_addresses(folder)
        except GraspdError:
            self._release()
            raise
        # The kernel kills a child when the thread that started the child ends, so one thread starts all children.
        self._thread = threading.Thread(target=self._run, name="supervisor", daemon=True)
        self._thread.start()

    def wait_ready(
        self,
        timeout: float = READY_S,
        *,
        say: Callable[[str], object] | None = None,
        stop: threading.Event | None = None,
    ) -> bool:
        """Wait until Redis, controller, workers and the API answer; return False if `stop` is set first.

        Raises UnavailableError, with the missing parts, after `timeout` [s], or earlier if a process ends repeatedly or
        an external Redis does not answer. Every 15 s, `say` is called with the missing parts.
        """
        began = told = time.monotonic()
        starts, logs = self._start_counts(), self.settings.data_dir / "logs"
        with closing(open_queue(self.settings, patience=0)) as queue:
            while missing := self._missing_parts(queue):
                if stop is not None and stop.is_set():
                    return False
                if "redis" in missing:  # Without Redis, other processes end and are not to blame.
                    starts = {**self._start_counts(), "redis": starts.get("redis", 0)}
                now = time.monotonic()
                patience = min(timeout, _REDIS_S) if "redis" in missing and self._wanted.redis_url else timeout
                if again := [name for name, n in self._start_counts().items() if n - starts.get(name, 0) >= _ENDS]:
                    raise UnavailableError(f"{', '.join(again)} ended {_ENDS} times before getting ready; see {logs}")
                if now - began > patience or self._stopping.is_set():
                    raise UnavailableError(f"not ready after {now - began:.0f} s: {', '.join(missing)}; see {logs}")
                if say is not None and now - told >= _TOLD_EVERY_S:
                    told = now
                    say(f"not ready after {now - began:.0f} s, waiting for {', '.join(missing)}; logs in {logs}")
                time.sleep(_PROBE_S)
        return True

    def stop(self) -> None:
        """Stop all children, workers first and Redis last. Idempotent."""
        self._stopping.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()
            self._thread = None
        self._release()

    def _start_counts(self) -> dict[str, int]:
        return {child.name: child.starts for child in list(self._children)}

    def _missing_parts(self, queue: RqQueue) -> list[str]:
        missing = []
        try:
            if not queue.is_announced(PART):
                missing.append("controller")
            beats = queue.workers()
            if sum(beat.state != "quarantined" for beat in beats) < self._workers:
                missing.append("; ".join(["workers", *sorted({beat.reason for beat in beats if beat.reason})]))
        except UnavailableError:
            missing.append("redis")
        if self._api and not missing and not self._api_is_ready():
            missing.append("api")
        return missing

    def _api_is_ready(self) -> bool:
        try:
            return httpx.get(f"{self.api_url}/readyz", timeout=5.0, trust_env=False).status_code == 200
        except httpx.HTTPError:
            return False

    def _resolve_settings(self) -> None:
        folder = self._wanted.data_dir.resolve()
        update: dict[str, object] = {"data_dir": folder}
        if self._api:
            reserved = bind_socket(self._wanted.host, self._wanted.port)
            update["port"] = reserved.getsockname()[1]
            if sys.platform == "linux":
                self._locks.append(reserved)
            else:  # Other systems refuse a second socket on one address.
                reserved.close()
        self.settings = self._wanted.model_copy(update=update)

    def _check_identity(self, folder: Path) -> None:
        """Check that store, index and Redis belong to one service; without Redis the children check it later."""
        open_store(self.settings.resolved_store_url)
        before = recorded_service(folder)
        try:
            services = Services.open(self.settings, patience=0)
        except UnavailableError as error:
            log.warning("%s", error)
            return
        with closing(services):
            mine = identify_if_redis_answers(services, folder=folder)
        if self._wanted.redis_url is None and before not in (None, mine):
            move_log(self.settings, "it belongs to the service that ran here before")

    def _create_children(self) -> list[Child]:
        environment = {
            "GRASPD_DATA_DIR": str(self.settings.data_dir),
            "GRASPD_REDIS_URL": self._joining.redis_url if self._joining else redis_url(self.settings),
            "GRASPD_HOST": self.settings.host,
            "GRASPD_PORT": str(self.settings.port),
            "GRASPD_API_URL": self.api_url,
            **_explicit_settings(self._wanted),
        }

        def child(name: str, *command: str, **more: str) -> Child:
            return Child(name, command, {**environment, **more}, self.settings.data_dir)

        children = []
        if self._wanted.redis_url is None:
            self._locks.append(lock_redis(self.settings))
            log.info("Redis: %s, from %s", *find_server())
            redis = child("redis", *server_command(self.settings, self._joining))
            redis.fix = lambda output: move_broken_log(self.settings, output)
            children.append(redis)
        # With an equal name, a restarted controller does not wait for the end of its earlier lease.
        name = self._wanted.controller_name or f"{socket.gethostname()}-up-{secrets.token_hex(8)}"
        children.append(child("controller", *_PROGRAM, "controller", GRASPD_CONTROLLER_NAME=name))
        if self._api:
            children.append(child("api", *_PROGRAM, "api"))
        for number in range(self._workers):
            place = {"GRASPD_WORKER_NUMBER": str(number), "GRASPD_WORKERS_HERE": str(self._workers)}
            children.append(child(f"worker-{number}", *self._worker_command, **place))
        return children

    def _run(self) -> None:
        try:
            keep_alive(self._children, self._stopping)
        except Exception:
            log.exception("the supervisor stops because of an error")
        finally:
            # Workers stop first, so that Redis and controller still accept their unfinished tasks.
            for names in ("worker", ("api", "controller"), "redis"):
                group = [child for child in self._children if child.name.startswith(names)]
                stop_children(group, self.settings.stop_grace_s)

    def _record_addresses(self, folder: Path) -> None:
        if self._joining is not None:
            self._joining.write(self.settings, self.api_url)
        try:
            if self._api:
                record_address(folder, self.api_url)
        except OSError as error:
            log.warning("the address of the API cannot be written to %s: %s", folder, error.strerror)

    def _release(self) -> None:
        if self._locks and self._joining is not None:
            self._joining.forget()
        if self._locks and self._api:
            forget_address(self._wanted.data_dir.resolve())
        for lock in self._locks:
            lock.close()
        self._locks = []


_SETTLED: Final = frozenset({"data_dir", "redis_url", "host", "port", "api_url"})


def _explicit_settings(settings: Settings) -> dict[str, str]:
    """Return the explicitly given settings, for the environment of the children."""
    given = settings.model_fields_set - _SETTLED
    return {f"GRASPD_{name.upper()}": _variable_text(getattr(settings, name)) for name in given}


def _variable_text(value: object) -> str:
    """Format a setting for the environment; "" means unset."""
    if isinstance(value, SecretStr):
        return value.get_secret_value()
    return "" if value is None else json.dumps(value) if isinstance(value, dict) else str(value)
