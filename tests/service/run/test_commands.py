"""The commands of the service: exit codes, one-line errors, JSON, private data, settings of the children."""

import json
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import typer
from pydantic import SecretStr, ValidationError
from typer.testing import CliRunner

from graspd import cli as program
from graspd.service.cli import load_settings, report_errors
from graspd.service.model.errors import InputError, StoreUnavailable, UnavailableError
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.leading import PART
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run.commands import app
from graspd.service.run.supervisor import _SETTLED, Supervisor, _explicit_settings
from graspd.service.settings import Settings
from tests.fakes import request
from tests.service.conftest import service

runner = CliRunner()


def _bad_model() -> ValidationError:
    with pytest.raises(ValidationError) as refused:
        request(grasps=0)
    return refused.value


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("no such\n  hand"), 2, "graspd: no such hand\n"),
        (StoreUnavailable("the disk is full"), 1, "graspd: the disk is full\n"),
        (KeyboardInterrupt(), 130, "graspd: interrupted\n"),
        (_bad_model(), 2, "graspd: grasps: must be at least 1\n"),
    ],
)
def test_an_error_is_one_line_and_an_exit_code(error: BaseException, code: int, line: str, capsys: Any) -> None:
    with pytest.raises(typer.Exit) as ended:
        report_errors(Mock(side_effect=error))()
    assert ended.value.exit_code == code
    assert capsys.readouterr().err == line


def test_a_bad_setting_names_its_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRASPD_LEASE_S", "soon")
    with pytest.raises(InputError, match=r"^GRASPD_LEASE_S: "):
        load_settings()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("GRASPD_KEEPER_INTERVAL_S", "GRASPD_CONTROLLER_INTERVAL_S"),
        ("GRASPD_KEEPER_NAME", "GRASPD_CONTROLLER_NAME"),
        ("GRASPD_SCRUB_MB_PER_S", "GRASPD_INTEGRITY_SCAN_MB_PER_S"),
    ],
)
def test_a_setting_of_0_2_is_refused_with_its_new_name(monkeypatch: pytest.MonkeyPatch, old: str, new: str) -> None:
    monkeypatch.setenv(old, "1")
    with pytest.raises(InputError, match=rf"^{old} was removed: use {new}$"):
        load_settings()
    monkeypatch.delenv(old)
    monkeypatch.setenv(new, "1")
    assert float(getattr(load_settings(), new.removeprefix("GRASPD_").lower())) == 1.0


@pytest.mark.parametrize("command", [["store", "verify"], ["index", "rebuild", "--check"], ["index", "rebuild"]])
def test_what_reads_a_store_makes_none_where_there_is_none(tmp_path: Path, command: list[str]) -> None:
    shown = runner.invoke(program.build_app(), ["admin", *command, "--data-dir", str(tmp_path / "mistyped")])
    assert shown.exit_code == 2
    assert f"there is no store at {tmp_path / 'mistyped' / 'store'}" in " ".join(shown.output.split())
    assert list(tmp_path.iterdir()) == []


def test_a_check_tells_differences_and_changes_nothing(tmp_path: Path) -> None:
    for services in service(tmp_path):
        job_actions.submit(services, request())
    damaged = ["index", "rebuild", "--check", "--data-dir", str(tmp_path)]
    assert runner.invoke(app, damaged).exit_code == 0
    for file in tmp_path.glob("index.sqlite*"):
        file.unlink()
    for _ in range(2):
        shown = runner.invoke(app, damaged)
        assert shown.exit_code == 1 and "not in the index" in shown.output
    rebuild = [*damaged[:2], "--json", *damaged[3:]]
    told = [runner.invoke(app, rebuild).stdout.splitlines()[-1] for _ in range(2)]
    assert [json.loads(line)["changed"] for line in told] == [True, False]
    assert runner.invoke(app, damaged).exit_code == 0


def test_up_on_a_taken_port_is_one_clear_line(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        shown = runner.invoke(app, ["up", "--port", str(port), "--data-dir", str(tmp_path / "data")])
    assert shown.exit_code == 1
    assert shown.stderr.splitlines()[-1].startswith(f"graspd: port {port} on 127.0.0.1 is in use; ")
    with Supervisor(Settings(data_dir=tmp_path / "data", port=0), workers=0, api=False):
        pass  # nothing was left locked


def test_up_on_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    shown = runner.invoke(app, ["up", "--port", "0", "--data-dir", str(tmp_path / "file" / "data")])
    assert shown.exit_code == 1
    assert shown.stderr.splitlines()[-1].endswith("file/data cannot be made: Not a directory")


def test_a_worker_that_never_gets_ready_is_named_with_its_log(tmp_path: Path) -> None:
    broken = (sys.executable, "-c", "raise SystemExit(3)")
    with (
        Supervisor(Settings(data_dir=tmp_path, port=0), workers=1, api=False, worker_command=broken) as supervisor,
        pytest.raises(UnavailableError, match=rf"worker-0 ended \d times before getting ready; see {tmp_path}/logs"),
    ):
        supervisor.wait_ready()


def test_a_wait_says_for_what_and_can_be_stopped_or_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.service.run.supervisor._TOLD_EVERY_S", 0.0)
    idle, stop, told = (sys.executable, "-c", "import signal; signal.pause()"), threading.Event(), []

    def say(line: str) -> None:
        told.append(line)
        if "waiting for workers;" in line:
            stop.set()

    with Supervisor(Settings(data_dir=tmp_path, port=0), workers=1, api=False, worker_command=idle) as supervisor:
        assert not supervisor.wait_ready(say=say, stop=stop)
        with pytest.raises(UnavailableError, match=rf"not ready after 0 s: .*workers; see {tmp_path}/logs"):
            supervisor.wait_ready(timeout=0)
    assert str(tmp_path / "logs") in told[-1]


def test_a_check_fails_without_process(rq_queue: RqQueue, redis_server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GRASPD_REDIS_URL", redis_server)
    for command in ("controller", "worker"):
        shown = runner.invoke(program.build_app(), [command, "--check"])
        assert (shown.exit_code, len(shown.stderr.splitlines())) == (1, 1)
    rq_queue.announce(PART, 60)
    assert runner.invoke(program.build_app(), ["controller", "--check"]).exit_code == 0


def test_the_controller_ends_well_on_sigterm(tmp_path: Path) -> None:
    environment = os.environ | {"GRASPD_DATA_DIR": str(tmp_path), "GRASPD_REDIS_URL": f"unix://{tmp_path}/none.sock"}
    code = "from graspd.service.run.commands import app; app(['controller'])"
    with subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=subprocess.PIPE) as controller:
        assert controller.stderr is not None
        # It waits for Redis instead of giving up.
        assert any("Redis does not answer" in line.decode() for line in controller.stderr)
        controller.send_signal(signal.SIGTERM)
        controller.stderr.read()
        assert controller.wait(timeout=60) == 0


def test_a_service_keeps_its_data_from_other_users(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    folder.mkdir()
    folder.chmod(0o755)
    environment = os.environ | {"GRASPD_DATA_DIR": str(folder), "GRASPD_REDIS_URL": f"unix://{tmp_path}/none.sock"}
    program = (
        "from graspd.service.cli import load_settings, set_up_process\n"
        "from graspd.service.pipeline.backends import Services\n"
        "settings = load_settings()\n"
        "set_up_process(settings, 'up')\n"
        "services = Services.open(settings)\n"
        "services.store.put('jobs/a/job.json', b'1')\n"
        "services.close()\n"
    )
    subprocess.run([sys.executable, "-c", program], env=environment, check=True, timeout=120, umask=0o022)
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in (folder, *folder.rglob("*"))}
    assert {path: oct(mode) for path, mode in modes.items() if mode & 0o077} == {}
    assert modes[folder] == 0o700


#: Values of each setting that its default is none of; texts hold what shells, JSON and URLs give a meaning.
_ODD = "a b\"c'd%20#e?f,ü{}"
_TEXTS = ("store_url", "store_public_endpoint", "proxy_addresses", "webhook_networks", "controller_name", "device")
_SECRETS = ("index_url", "api_key", "proxy_secret", "webhook_secret")
_PATHS = ("keys_file", "kernels", "heartbeat_file")
VALUES: dict[str, Any] = {
    **dict.fromkeys(_TEXTS, _ODD),
    **dict.fromkeys(_SECRETS, SecretStr(f"{_ODD} and at least sixteen")),
    **{name: Path(f"/srv/{_ODD}/{name}") for name in _PATHS},
    "price_unit": "EUR",
    "proxy_groups": {'lab, the "first"': "vision:submit", "ü": ":admin", "*": ":read"},
    "metrics_need_key": False,
    "log_level": "DEBUG",
    "log_format": "json",
    "prefilter": "off",
    "join": "4",
    "worker_number": 0,
    "api_root_path": "/graspd",
    "docs_url": "https://docs.example.org/a?b=%20",
    "lease_s": 4 / 3,
    "quota_jobs_per_day": 7,
}


def value_of(name: str) -> Any:
    if name in VALUES:
        return VALUES[name]
    default = Settings.model_fields[name].default
    assert isinstance(default, int | float), f"the test has no value for {name}"
    return default + 1


@pytest.mark.parametrize("name", sorted(Settings.model_fields.keys() - _SETTLED))
def test_a_setting_reaches_the_children(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = Settings(**{name: value_of(name)})
    for variable, text in _explicit_settings(given).items():
        monkeypatch.setenv(variable, text)
    assert getattr(Settings(), name) == getattr(given, name)


@pytest.mark.parametrize(
    "name", [name for name, field in Settings.model_fields.items() if field.default is None and name not in _SETTLED]
)
def test_a_setting_taken_back_does_not_come_from_the_environment(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    value = value_of(name)
    text = value.get_secret_value() if isinstance(value, SecretStr) else str(value)
    monkeypatch.setenv(f"GRASPD_{name.upper()}", text)
    for variable, text in _explicit_settings(Settings(**{name: None})).items():
        monkeypatch.setenv(variable, text)
    assert getattr(Settings(), name) is None


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """An environment without settings."""
    for name in [name for name in os.environ if name.upper().startswith("GRASPD_")]:
        monkeypatch.delenv(name)
    return monkeypatch


def test_defaults_count_until_a_value_is_set_and_a_bad_one_is_refused(bare: pytest.MonkeyPatch) -> None:
    assert load_settings().processes == 0
    bare.setenv("graspd_processes", "3")
    assert load_settings().processes == 3
    bare.setenv("GRASPD_PREFILTER", "perhaps")
    with pytest.raises(InputError, match="GRASPD_PREFILTER"):
        load_settings()
