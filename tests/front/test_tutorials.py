"""The tutorials, run as they are printed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import graspd
from tests.conftest import REPOSITORY
from tests.docs_commands import run_page

TUTORIALS = sorted((REPOSITORY / "docs" / "tutorials").glob("*.md"))


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_the_commands_of_a_tutorial_run(page: Path, tmp_path: Path) -> None:
    assert run_page(page, "", tmp_path) == []


def test_the_lines_that_read_the_first_grasps_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    graspd.synthesize("allegro", "mug", count=4, fidelity="draft", seed=1).save("mug.h5")
    (block,) = re.findall(r"```python\n(.*?)```", (TUTORIALS[0]).read_text(), re.DOTALL)
    said: dict[str, Any] = {}
    exec(block, said)
    best = said["best"]
    assert (len(best), best.joint_positions.shape) == (3, (3, 16)) and (best.metric("epsilon") > 0).all()
