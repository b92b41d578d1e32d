"""What every error keeps: one line, no secret, words of this project; and names that do not fit."""

import logging
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from graspd.api.uploads import name_of_upload
from graspd.exchange.plan import plain_name
from graspd.service.index.database import read_condition
from graspd.service.index.index import Index
from graspd.service.model.base import first_error
from graspd.service.model.errors import ERRORS, GraspdError, InputError, without_secrets
from graspd.service.model.names import shorten_name
from graspd.service.queue.connection import connect
from graspd.service.run.address import ListenAddress
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from graspd.service.telemetry import JsonFormatter, _TextFormatter
from tests.fakes import request


@pytest.mark.parametrize("kind", ERRORS.values(), ids=ERRORS.keys())
def test_a_quoted_line_break_does_not_make_a_second_line(kind: type[GraspdError]) -> None:
    assert str(kind("asset.json: a\n  b: unknown key")) == "asset.json: a b: unknown key"


def test_controls_of_a_terminal_are_quoted_and_other_scripts_are_not() -> None:
    for character in "\r\x1b\x85\u2028\x00":
        assert str(GraspdError(f"a{character}b")).isprintable()
    assert str(GraspdError("no hand 'Hände 手'")) == "no hand 'Hände 手'"


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"grasps": "many"}, "grasps: must be a whole number"),
        ({"grasps": 1.5}, "grasps: must be a whole number"),
        ({"friction": 0}, "friction: must be more than 0"),
        ({"friction": "half"}, "friction: must be a number"),
        ({"stereo": "perhaps"}, "stereo: must be true or false"),
        ({"want": "vaild"}, "want: must be one of valid, candidates; did you mean valid?"),  # codespell:ignore vaild
        ({"target": "x" * 41}, "target: must have at most 40 characters"),
        ({"fidelity": "paint"}, "fidelity: unknown fidelity 'paint'"),
    ],
)
def test_the_first_mistake_is_one_line(given: dict[str, Any], line: str) -> None:
    with pytest.raises(ValidationError) as refused:
        request(**given)
    assert first_error(refused.value).startswith(line)
    assert "nput should" not in first_error(refused.value)


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
    told = (str(GraspdError(text)), JsonFormatter("api").format(record), _TextFormatter().format(record))
    assert not [one for one in told if SECRET in one]


@pytest.mark.parametrize(
    "text", ["file:///srv/a@b/store", "see https://example.org/a?x=1", "unix:///srv/a@b", "mail a@b.c", "graspd: gd_x"]
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


@pytest.mark.parametrize("url", [f"postgresql+psycopg://me:x@host:{SECRET}/db", f"mysql://me:{SECRET}@host/db", SECRET])
def test_a_url_that_is_refused_is_told_without_password(url: str) -> None:
    for opened in (Index, read_condition):
        with pytest.raises(InputError, match=r"\(GRASPD_INDEX_URL\) cannot be used") as refused:
            opened(url)
        assert SECRET not in str(refused.value)
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
    assert SECRET not in f"{refused.value!r} {refused.value} {ListenAddress(Path(), 'host', '127.0.0.1', 1, SECRET)!r}"


LONG = "mujoco-Office_Depot_Canon_CL211XL_Remanufactured_Ink_Cartridge_TriColor"


def test_a_long_name_of_an_upload_is_refused_others_are_cut(caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(InputError, match=f"the name {LONG} has 71 characters, more than 64; give"):
        name_of_upload(f"{LONG}.stl")
    shorten_name.cache_clear()
    first, second = plain_name(LONG), plain_name(f"{LONG}2")
    assert first != second and len(first) == len(second) == 64
    assert plain_name(LONG) == first
    assert [record.getMessage() for record in caplog.records] == [
        f"the name {name} has more than 64 characters; it becomes {short}"
        for name, short in ((LONG, first), (f"{LONG}2", second))
    ]
    assert plain_name("sem-Bottle a86d") == "sem-Bottle-a86d" and name_of_upload("mug.stl") == "mug"
