"""What other machines need to join: asked for before anything starts, told in a file of its user's own."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from graspd.service.model.errors import GraspdError, InputError, UnavailableError
from graspd.service.run.address import joining
from graspd.service.settings import Settings
from tests.servers import free_ports


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", store_url=f"file://{tmp_path}/the store")


def test_the_file_holds_what_a_shell_reads_and_nobody_else_may(settings: Settings, tmp_path: Path) -> None:
    file = tmp_path / "shared" / "join.env"
    others = joining(settings, file, host="127.0.0.1")
    others.write(settings, "http://127.0.0.1:8000")
    assert file.read_text().splitlines() == [
        f"GRASPD_REDIS_URL=redis://:{others.password}@127.0.0.1:{others.port}/0",
        f"GRASPD_STORE_URL='file://{tmp_path}/the store'",
        "GRASPD_API_URL=http://127.0.0.1:8000",
    ]
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert list(file.parent.iterdir()) == [file], "no draft is left"


def test_a_service_forgets_its_own_file_and_not_that_of_its_successor(settings: Settings, tmp_path: Path) -> None:
    first, second = (joining(settings, tmp_path / "join.env", host="127.0.0.1") for _ in range(2))
    assert first.password != second.password
    first.write(settings, "http://a")
    second.write(settings, "http://b")
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
    settings: Settings, tmp_path: Path, changes: dict[str, str | None], host: str, told: str
) -> None:
    with pytest.raises(InputError, match=told):
        joining(settings.model_copy(update=changes), tmp_path / "join.env", host=host)


def test_a_port_that_is_wished_for_is_taken_or_refused(settings: Settings, tmp_path: Path) -> None:
    (port,) = free_ports(1)
    assert joining(settings, tmp_path / "join.env", host="127.0.0.1", port=port).port == port


def test_a_folder_that_cannot_be_written_is_an_error_of_ours(settings: Settings, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UnavailableError) as error:
        joining(settings, tmp_path / "file" / "join.env", host="127.0.0.1").write(settings, "http://a")
    assert isinstance(error.value, GraspdError)
