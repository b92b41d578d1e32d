"""The data folder is for its user alone."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("was_open", [True, False])
def test_a_service_keeps_its_data_from_other_users(tmp_path: Path, was_open: bool) -> None:
    folder = tmp_path / "data"
    if was_open:
        folder.mkdir()
        folder.chmod(0o755)
    environment = os.environ | {"GRASPD_DATA_DIR": str(folder), "GRASPD_REDIS_URL": f"unix://{tmp_path}/none.sock"}
    program = (
        "from graspd.service.cli import keep_private, load_settings\n"
        "from graspd.service.pipeline.backends import Services\n"
        "settings = load_settings()\n"
        "keep_private(settings)\n"
        "services = Services.open(settings)\n"
        "services.store.put('jobs/a/job.json', b'1')\n"
        "services.close()\n"
    )
    subprocess.run([sys.executable, "-c", program], env=environment, check=True, timeout=120, umask=0o022)
    modes = {path: stat.S_IMODE(path.stat().st_mode) for path in (folder, *folder.rglob("*"))}
    assert {path: oct(mode) for path, mode in modes.items() if mode & 0o077} == {}
    assert modes[folder] == 0o700


@pytest.mark.parametrize("room", ["api/server_command.py", "service/run/commands.py", "graspd/commands/worker.py"])
def test_every_service_command_is_private(room: str) -> None:
    text = (Path(__file__).parents[3] / room).read_text()
    assert text.count('log_to_stderr(settings, "') == text.count("keep_private(settings)") > 0
