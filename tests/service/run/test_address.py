"""The service of a data folder is found where it says it answers, and not where one that is gone did."""

from __future__ import annotations

import json
import os
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.api.server import bind
from graspd.client.reports import open_client
from graspd.service.run.address import forget_address, record_address, recorded_address
from graspd.service.run.supervisor import Supervisor, _reserve
from graspd.service.settings import Settings

URL = "http://127.0.0.1:45678"


def a_process_that_is_gone() -> int:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    return child.pid


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("GRASPD_API_URL", raising=False)
    monkeypatch.setenv("GRASPD_DATA_DIR", str(tmp_path))
    return tmp_path


def asked() -> str:
    with open_client(None) as client:
        return client.url


def test_the_client_asks_the_service_of_its_data_folder(folder: Path) -> None:
    record_address(folder, URL)
    assert asked() == URL


def test_a_url_that_was_given_goes_before(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record_address(folder, URL)
    monkeypatch.setenv("GRASPD_API_URL", "http://127.0.0.1:1234")
    assert asked() == "http://127.0.0.1:1234"
    with open_client("http://127.0.0.1:99") as client:
        assert client.url == "http://127.0.0.1:99"


def test_without_a_record_the_client_asks_the_usual_address(folder: Path) -> None:
    assert asked() == "http://127.0.0.1:8000"


def test_the_record_of_a_service_that_is_gone_is_not_believed(folder: Path) -> None:
    record_address(folder, URL)
    record = json.loads((folder / "api.json").read_text())
    (folder / "api.json").write_text(json.dumps(record | {"pid": a_process_that_is_gone()}))
    assert recorded_address(folder) is None
    assert asked() == "http://127.0.0.1:8000"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "3",
        '{"api_url": 5, "pid": 1}',
        '{"api_url": "file:///x", "pid": 1}',
        '{"api_url": "http://x", "pid": "1"}',
        '{"api_url": "http://x", "pid": ' + "9" * 40 + "}",
    ],
)
def test_a_record_that_makes_no_sense_is_no_record(folder: Path, text: str) -> None:
    (folder / "api.json").write_text(text)
    assert recorded_address(folder) is None


def test_the_record_is_for_its_user_alone_and_leaves_no_scraps(folder: Path) -> None:
    record_address(folder, URL)
    assert stat.S_IMODE((folder / "api.json").stat().st_mode) == 0o600
    assert [file.name for file in folder.iterdir()] == ["api.json"]


def test_only_the_process_that_wrote_the_record_takes_it_away(folder: Path) -> None:
    record_address(folder, URL)
    (folder / "api.json").write_text(json.dumps({"api_url": URL, "pid": os.getppid()}))
    forget_address(folder)
    assert recorded_address(folder) == URL
    record_address(folder, URL)
    forget_address(folder)
    assert recorded_address(folder) is None


def test_a_service_on_any_free_port_is_found_by_its_data_folder_until_it_stops(folder: Path) -> None:
    supervisor = Supervisor(Settings(data_dir=folder, port=0, device="cpu"), workers=0)
    with supervisor:
        assert not supervisor.api_url.endswith(":0")
        assert asked() == supervisor.api_url
    assert recorded_address(folder) is None


@pytest.mark.skipif(sys.platform != "linux", reason="a second socket of one address is refused there")
def test_a_port_that_was_found_free_is_kept_for_the_api() -> None:
    with _reserve("127.0.0.1", 0) as reserved, socket.socket() as stranger:
        address = reserved.getsockname()
        with pytest.raises(OSError, match="in use"):
            stranger.bind(address)
        for _ in range(2):  # an API that is started again takes it again
            bind(*address).close()
