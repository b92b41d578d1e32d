"""No secret leaves in an error, a log line or the text of a setting."""

from __future__ import annotations

import logging

import pytest
from pydantic import ValidationError

from graspd.service.index.index import Index
from graspd.service.index.sample import look
from graspd.service.model.errors import GraspdError, InputError, without_secrets
from graspd.service.queue.connection import connect
from graspd.service.run.address import ListenAddress
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from graspd.service.telemetry import JsonLines, _TextLines

SECRET = "s3cr3t"
QUOTING = [
    f"redis://:{SECRET}@host:6379/0 is away",
    f"redis://:a/b#{SECRET}@host:6379",
    f"postgresql+psycopg://me:{SECRET}@host/db?sslmode=require",
    f"postgresql://host/db?user=me&password={SECRET}&x=1",
    f"https://bucket.example/x?X-Amz-Signature={SECRET}&X-Amz-Expires=60",
    f"az://box?sig={SECRET}",
    f"'Authorization': 'Bearer gd_{SECRET}_and_more'",
]


@pytest.mark.parametrize("text", QUOTING)
def test_an_error_and_a_log_line_hold_no_secret(text: str) -> None:
    record = logging.LogRecord("graspd", logging.WARNING, "", 0, "%s", (text,), None)
    record.detail = text
    told = (str(GraspdError(text)), JsonLines("api").format(record), _TextLines().format(record))
    assert not [one for one in told if SECRET in one]


@pytest.mark.parametrize(
    "text",
    ["file:///srv/a@b/store", "see https://example.org/a?x=1", "unix:///srv/a@b", "mail a@b.c", "graspd: gd_x"],
)
def test_what_is_no_secret_stays(text: str) -> None:
    assert without_secrets(text) == text


@pytest.mark.parametrize(
    "url", [f"redis://:{SECRET}/x@host:6379", f"redis://:x@host:{SECRET}", f"http://me:{SECRET}@host", f"{SECRET}"]
)
def test_a_redis_url_that_cannot_be_used_is_not_told(url: str) -> None:
    with pytest.raises(GraspdError, match=r"\(GRASPD_REDIS_URL\) cannot be used") as refused:
        connect(url)
    assert SECRET not in str(refused.value)


@pytest.mark.parametrize(
    "url", [f"postgresql+psycopg://me:x@host:{SECRET}/db", f"mysql://me:{SECRET}@host/db", f"{SECRET}", f"{SECRET}://x"]
)
def test_an_index_url_that_cannot_be_used_is_one_line_without_its_password(url: str) -> None:
    for opened in (Index, look):
        with pytest.raises(InputError, match=r"\(GRASPD_INDEX_URL\) cannot be used"):
            opened(url)
    if not url.startswith(f"{SECRET}:"):
        with pytest.raises(InputError) as refused:
            Index(url)
        assert SECRET not in str(refused.value)


def test_a_store_url_that_cannot_be_used_is_told_without_its_password() -> None:
    with pytest.raises(InputError) as refused:
        open_store(f"s4://me:{SECRET}@host")
    assert SECRET not in str(refused.value)


def test_settings_show_no_secret(monkeypatch: pytest.MonkeyPatch) -> None:
    given = dict.fromkeys(("redis_url", "index_url", "api_key", "proxy_secret"), f"redis://:{SECRET}@host")
    shown = Settings(**given)
    assert SECRET not in f"{shown!r} {shown}"
    monkeypatch.setenv("GRASPD_WEBHOOK_SECRET", SECRET)
    with pytest.raises(ValidationError) as refused:
        Settings()
    assert SECRET not in f"{refused.value!r} {refused.value}"


def test_what_other_machines_join_with_is_not_shown(tmp_path: object) -> None:
    assert SECRET not in repr(ListenAddress(tmp_path, "host", "127.0.0.1", 1, SECRET))  # type: ignore[arg-type]
