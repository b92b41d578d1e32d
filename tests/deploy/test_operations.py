"""The steps of docs/how-to/operations.md, run as they stand there."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Final

import pytest

from graspd.service.index.index import Index
from graspd.service.index.rebuild import differences
from graspd.service.model.states import State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.identity import identify
from graspd.service.settings import Settings
from graspd.service.store.library import publish_builtins
from tests.conftest import REPOSITORY
from tests.deploy import composition
from tests.fakes import finish, request
from tests.service.conftest import service
from tests.shell import completed

TEXT: Final = "\n".join((REPOSITORY / "docs" / "how-to" / page).read_text() for page in ("install.md", "operations.md"))
_TRIED: Final = re.compile(r"<!-- tried: ([\w-]+) -->\n```sh\n(.*?)```", re.DOTALL)


def run_block(name: str, folder: Path, environment: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a marked block as a user would, `graspd` being that of this environment; a failing line ends it."""
    shims = folder / "bin"
    shims.mkdir(exist_ok=True)
    shim = shims / "graspd"
    shim.write_text(f'#!/bin/sh\nexec {sys.executable} -m graspd "$@"\n')
    shim.chmod(0o755)
    return completed(
        ["bash", "-euo", "pipefail", "-c", dict(_TRIED.findall(TEXT))[name]],
        cwd=folder,
        env=os.environ | {"PATH": f"{shims}:{os.environ['PATH']}", "PYTHONPATH": str(REPOSITORY)} | dict(environment),
    )


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Services]:
    """A data folder with a finished job and one that has not begun."""
    for services in service(tmp_path / "data"):
        identify(services)
        publish_builtins(services.store)
        finish(services, job_actions.submit(services, request(grasps=64, scenes=1))[0].id)
        job_actions.submit(services, request(grasps=32, seed=5))
        yield services


def names_of(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_a_back_up_restored_elsewhere_gives_the_same_index(kept: Services, tmp_path: Path) -> None:
    data, fresh = kept.settings.data_dir, tmp_path / "new"
    (data / "keys.json").write_text("{}")
    (data / "store" / "shards" / "half-written.h5#123").write_bytes(b"half")
    where = {"GRASPD_DATA_DIR": str(data), "NEW_DATA_DIR": str(fresh)}
    for step in ("back-up", "restore"):
        done = run_block(step, tmp_path, where)
        assert done.returncode == 0, done.stderr
    assert names_of(fresh / "store") == names_of(data / "store") - {"shards/half-written.h5#123"}
    assert (fresh / "keys.json").exists()
    with closing(Index(Settings(data_dir=fresh).resolved_index_url)) as restored:
        assert differences(restored, kept.store) == []
        jobs = {job.id: job.state for job in restored.jobs.page(limit=10).items}
        assert jobs == {job.id: job.state for job in kept.index.jobs.page(limit=10).items}
        assert set(jobs.values()) == {State.SUCCEEDED, State.QUEUED}


def test_a_back_up_works_where_no_key_was_ever_made(kept: Services, tmp_path: Path) -> None:
    done = run_block("back-up", tmp_path, {"GRASPD_DATA_DIR": str(kept.settings.data_dir)})
    assert done.returncode == 0, done.stderr


def test_keys_are_made_rotated_limited_and_revoked(tmp_path: Path) -> None:
    done = run_block("keys", tmp_path, {"GRASPD_DATA_DIR": str(tmp_path / "data"), "COLUMNS": "200"})
    assert done.returncode == 0, done.stderr
    first, second = re.findall(r"^(gd_\S+)", done.stdout, re.MULTILINE)
    assert first != second
    assert first not in (tmp_path / "data" / "keys.json").read_text()


def test_every_profile_service_and_variant_on_the_page_exists() -> None:
    profiles = {name for service in composition.SERVICES.values() for name in service.get("profiles", ())}
    assert set(re.findall(r"--profile (\S+)", TEXT)) <= profiles
    assert set(re.findall(r"--scale ([\w-]+)=", TEXT)) <= composition.SERVICES.keys()
    for variant in re.findall(r"apply -k (\S+)", TEXT):
        assert (REPOSITORY / variant / "kustomization.yaml").is_file()
