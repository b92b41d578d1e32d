"""docs/how-to/clouds.md does what it prints."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import REPOSITORY
from tests.service.readers import box_scenes


def test_the_page_runs_as_it_is_printed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "demo-out").mkdir()
    box_scenes.write(tmp_path / "demo-out" / "shards")
    monkeypatch.chdir(tmp_path)
    page = (REPOSITORY / "docs" / "how-to" / "clouds.md").read_text()
    said: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        if "torch" not in block or find_spec("torch") is not None:
            exec(block, said)
    sample = said["sample"]
    assert sample["cloud/points"].shape == (1024, 3) and sample["cloud/seen"] > 100
    listed = re.findall(r"^\| (`[^|]*`) \| ", page, re.MULTILINE)
    keys = {name for cell in listed for name in re.findall(r"`([\w/]+)`", cell) if "/" in name or name == "base_id"}
    sample = said["views"].clouds(8, hand_surface=lambda _, rows: np.zeros((len(rows), 1, 3)))[0]
    assert keys <= set(sample), "the table names what is not there"
    of_clouds = {
        name for name in sample if name.split("/")[0] in ("cloud", "camera", "table", "object") and "/" in name
    }
    assert of_clouds <= keys, "the table leaves something out"
