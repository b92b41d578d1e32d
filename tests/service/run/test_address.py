"""The service of a data folder: found, joined by others; earlier ones are not in its way, second ones are refused."""

import json
import os
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.client.reports import open_client
from graspd.service.index.index import Index
from graspd.service.model.errors import InputError, UnavailableError
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.identity import identify
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run.address import bind_socket, forget_address, new_listen_address, record_address, recorded_address
from graspd.service.run.children import Child, kill_leftovers, start_time
from graspd.service.run.doctor.backends import check_index_identity
from graspd.service.run.doctor.checks import Condition
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.indexes import empty_index
from tests.servers import free_ports
from tests.shell import completed
from tests.waiting import PATIENCE_S, until

URL = "http://127.0.0.1:45678"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("GRASPD_API_URL", raising=False)
    monkeypatch.setenv("GRASPD_DATA_DIR", str(tmp_path))
    return tmp_path


def asked() -> str:
    with open_client(None) as client:
        return client.url


def test_the_client_asks_the_service_of_its_data_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert asked() == "http://127.0.0.1:8000", "without a record the usual address"
    record_address(folder, URL)
    assert stat.S_IMODE((folder / "api.json").stat().st_mode) == 0o600
    assert [file.name for file in folder.iterdir()] == ["api.json"]
    assert asked() == URL
    monkeypatch.setenv("GRASPD_API_URL", "http://127.0.0.1:1234")
    assert asked() == "http://127.0.0.1:1234"
    with open_client("http://127.0.0.1:99") as client:
        assert client.url == "http://127.0.0.1:99"


_WRONG = ({"api_url": 5}, {"api_url": "file:///x"}, {"pid": str(os.getpid())}, {"pid": 1}, {"pid": 10**40})


@pytest.mark.parametrize("change", [*_WRONG, {"pid": 2**22 + 1}, {"started": ""}, {"started": None}, "", "[]", "3"])
def test_a_record_of_nonsense_or_of_another_process_is_none(folder: Path, change: dict[str, object] | str) -> None:
    record_address(folder, URL)
    record = json.loads((folder / "api.json").read_text())
    (folder / "api.json").write_text(change if isinstance(change, str) else json.dumps(record | change))
    assert recorded_address(folder) is None
    assert asked() == "http://127.0.0.1:8000"


def test_only_the_process_that_wrote_the_record_takes_it_away(folder: Path) -> None:
    record_address(folder, URL)
    parent = {"api_url": URL, "pid": os.getppid(), "started": start_time(os.getppid())}
    (folder / "api.json").write_text(json.dumps(parent))
    forget_address(folder)
    assert recorded_address(folder) == URL
    record_address(folder, URL)
    forget_address(folder)
    assert recorded_address(folder) is None


def test_a_service_on_any_free_port_is_found_until_it_stops(folder: Path) -> None:
    supervisor = Supervisor(Settings(data_dir=folder, port=0, device="cpu"), workers=0)
    with supervisor:
        assert not supervisor.api_url.endswith(":0")
        assert asked() == supervisor.api_url
    assert recorded_address(folder) is None


@pytest.mark.skipif(sys.platform != "linux", reason="a second socket of one address is refused there")
def test_a_port_that_was_found_free_is_kept_for_the_api() -> None:
    with bind_socket("127.0.0.1", 0) as reserved, socket.socket() as stranger:
        address = reserved.getsockname()
        with pytest.raises(OSError, match="in use"):
            stranger.bind(address)
        for _ in range(2):  # an API that is started again takes it again
            with bind_socket(*address) as listener:
                listener.listen()


@pytest.fixture
def joining_settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", store_url=f"file://{tmp_path}/the store")


def test_the_file_holds_what_a_shell_reads_and_nobody_else_may(joining_settings: Settings, tmp_path: Path) -> None:
    file, (port,) = tmp_path / "shared" / "join.env", free_ports(1)
    others = new_listen_address(joining_settings, file, host="127.0.0.1", port=port)
    others.write(joining_settings, "http://127.0.0.1:8000")
    assert file.read_text().splitlines() == [
        f"GRASPD_REDIS_URL=redis://:{others.password}@127.0.0.1:{port}/0",
        f"GRASPD_STORE_URL='file://{tmp_path}/the store'",
        "GRASPD_API_URL=http://127.0.0.1:8000",
    ]
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert list(file.parent.iterdir()) == [file], "no draft is left"


def test_a_service_forgets_its_own_file_and_not_its_successors(joining_settings: Settings, tmp_path: Path) -> None:
    first, second = (new_listen_address(joining_settings, tmp_path / "join.env", host="127.0.0.1") for _ in range(2))
    assert first.password != second.password
    first.write(joining_settings, "http://a")
    second.write(joining_settings, "http://b")
    first.forget()
    assert "http://b" in (tmp_path / "join.env").read_text()
    second.forget()
    second.forget()
    assert not (tmp_path / "join.env").exists()


@pytest.mark.parametrize(
    ("changes", "host", "told"),
    [
        ({"store_url": None}, "127.0.0.1", "GRASPD_STORE_URL"),
        ({"redis_url": "redis://elsewhere"}, "127.0.0.1", "GRASPD_REDIS_URL"),
        ({}, "192.0.2.1", "--share-host"),
        ({}, "no-such-host.invalid", "--share-host"),
    ],
)
def test_what_cannot_be_shared_is_refused_with_its_mend(
    joining_settings: Settings, tmp_path: Path, changes: dict[str, str | None], host: str, told: str
) -> None:
    with pytest.raises(InputError, match=told):
        new_listen_address(joining_settings.model_copy(update=changes), tmp_path / "join.env", host=host)


def test_a_folder_that_cannot_be_written_is_an_error_of_ours(joining_settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UnavailableError):
        new_listen_address(joining_settings, tmp_path / "file" / "join.env", host="127.0.0.1").write(
            joining_settings, "http://a"
        )


_WAIT = "import signal; signal.pause()"


@pytest.fixture
def stranger(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """An editor, say: the folder's path is in its command line and in its environment."""
    command = [sys.executable, "-c", _WAIT, str(tmp_path)]
    with subprocess.Popen(command, env={**os.environ, "GRASPD_DATA_DIR": str(tmp_path)}) as process:
        yield process
        process.kill()


@pytest.fixture
def child(tmp_path: Path) -> Iterator[Child]:
    made = Child("worker-0", (sys.executable, "-c", _WAIT), {}, tmp_path)
    made.start()
    assert made.process is not None
    # While it becomes its program, its environment cannot be read.
    command = Path(f"/proc/{made.process.pid}/cmdline")
    until(lambda: _WAIT in command.read_text() and "launch" not in command.read_text(), "the child runs")
    yield made
    made.process.kill()
    made.process.wait()


def pid_file(folder: Path, content: object) -> Path:
    file = folder / "run" / "worker-0.pid"
    file.parent.mkdir(exist_ok=True)
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    return file


def test_a_child_that_was_left_behind_is_ended(child: Child, tmp_path: Path) -> None:
    assert child.process is not None
    assert kill_leftovers(tmp_path) == [child.process.pid]
    assert child.process.wait(timeout=60) < 0
    assert not list((tmp_path / "run").iterdir())


def test_a_stranger_with_that_pid_lives_on(child: Child, stranger: subprocess.Popen[bytes], tmp_path: Path) -> None:
    assert child.pid_file is not None
    _, started, token = json.loads(child.pid_file.read_text())
    for stale in (
        [stranger.pid, started, token],
        [stranger.pid, start_time(stranger.pid), token],
        [stranger.pid, "", ""],
        str(stranger.pid),
    ):
        file = pid_file(tmp_path, stale)
        assert kill_leftovers(tmp_path) == []
        assert stranger.poll() is None
        assert not file.exists()


@pytest.mark.parametrize(
    "pid",
    [os.getpid(), os.getppid(), 0, -1, 1, "1", None, 10**30, True],
    ids=["itself", "parent", "0", "-1", "1", "text", "none", "huge", "true"],
)
def test_up_ends_neither_itself_nor_its_parent_nor_nonsense(pid: object, tmp_path: Path) -> None:
    started = start_time(pid) if isinstance(pid, int) else ""
    pid_file(tmp_path, [pid, started, ""])
    assert kill_leftovers(tmp_path) == []


COMMANDS = [["up", "--workers", "0", "--port", "0"], ["api", "--port", "0"], ["controller"], ["worker"]]


@pytest.fixture
def first(tmp_path: Path, rq_queue: RqQueue, redis_server: str) -> Iterator[Services]:
    settings = Settings(data_dir=tmp_path / "first", redis_url=redis_server)
    empty_index(settings.resolved_index_url).close()
    made = Services.open(settings)
    identify(made)
    yield made
    made.close()


def run(command: list[str], folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    variables = {**os.environ, "GRASPD_DATA_DIR": str(folder), "GRASPD_LOG_LEVEL": "ERROR", **environment}
    return completed([sys.executable, "-m", "graspd", *command], env=variables)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_command_of_a_second_service_on_a_redis_is_refused(
    command: list[str], first: Services, redis_server: str, tmp_path: Path
) -> None:
    done = run(command, tmp_path / "second", GRASPD_REDIS_URL=redis_server)
    said = done.stderr.splitlines()[-1]
    assert (done.returncode, said.split(";")[0]) == (1, "graspd: this Redis belongs to another graspd service")
    assert "Traceback" not in done.stderr


def test_the_doctor_says_so(first: Services, redis_server: str, tmp_path: Path) -> None:
    (tmp_path / "second" / "store").mkdir(parents=True)
    second = Settings(data_dir=tmp_path / "second", redis_url=redis_server)
    assert check_index_identity(first.settings).condition is Condition.GOOD
    assert check_index_identity(second).condition is Condition.BAD


def test_another_number_of_database_is_another_redis(first: Services, redis_server: str, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "second", redis_url=f"{redis_server}?db=1")
    empty_index(settings.resolved_index_url).close()
    second = Services.open(settings)
    second.queue.connection.flushdb()
    assert identify(second) != first.queue.service_id()
    second.close()


NAMES = "100% a%20b a#b what? größe q'u\"o\\te a&b=c;d [1] a:b@c {x} ~ $HOME"


@pytest.mark.parametrize("name", [*NAMES.split(), "a b", "a\nb"])
def test_store_and_index_lie_in_the_folder_and_nothing_beside_it(name: str, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / name)
    store = open_store(settings.resolved_store_url)
    store.put("jobs/one/job.json", b"{}")
    assert [(entry.key, store.get(entry.key)) for entry in store.list("jobs")] == [("jobs/one/job.json", b"{}")]
    assert (settings.data_dir / "store" / "jobs" / "one" / "job.json").exists()
    index = Index(settings.resolved_index_url)
    index.notes.set_service_id("one")
    index.close()
    again = Index(settings.resolved_index_url)
    assert again.notes.service_id() == "one"
    again.close()
    assert (settings.data_dir / "index.sqlite").exists()
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_whole_service_gets_ready_in_an_odd_folder(tmp_path: Path) -> None:
    name = "100% #1? ü a\nb 'c' \"d\" \\e " + "x" * 60
    settings = Settings(data_dir=tmp_path / name, port=0)
    with Supervisor(settings, workers=0) as supervisor:
        assert supervisor.wait_ready(PATIENCE_S)
        services = Services.open(supervisor.settings)
        assert services.queue.service_id() == services.index.notes.service_id()
        services.close()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("end", ["a?b", "a#b", "a\nb", "a\tb", "a?", "a#"])
def test_a_store_url_that_would_be_cut_off_is_refused(end: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="%3F"):
        open_store(f"file://{tmp_path}/{end}")
    assert not list(tmp_path.iterdir())
