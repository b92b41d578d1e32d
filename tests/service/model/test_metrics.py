"""One row more in the table of metrics is found everywhere: stored, indexed, filtered, shown and documented."""

import json
import sys
from typing import Any

import pytest

from benchmarks.large_index import fill
from graspd.service.index.index import Index
from graspd.service.store.store import open_store
from tests.conftest import REPOSITORY
from tests.one_more_metric import MEANING, NAME, TITLE
from tests.shell import completed

Found = dict[str, Any]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Found:
    folder = tmp_path_factory.mktemp("metric")
    older = f"sqlite:///{folder / 'older.sqlite'}"
    index = Index(older)
    fill(index, open_store("memory://"), grasps=64, jobs=2)
    index.close()
    command = [sys.executable, "-m", "tests.one_more_metric", str(folder / "new"), older]
    (folder / "new").mkdir()
    done = completed(command, cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_shard_manifest_and_index_have_it_and_an_older_index_too(found: Found) -> None:
    assert found["schema"] == MEANING and found["manifest"][0] == 0 and found["manifest"][-1] == 20
    assert NAME in found["index columns"] and f"grasps_{NAME}" in found["index indexes"]
    assert found["older index"] == [None] * 50


def test_the_api_filters_and_sorts_by_it_and_tells_it(found: Found) -> None:
    assert len(found["answer"]) >= 8
    assert found["answer"] == sorted(found["answer"]) and 5 <= found["answer"][0] <= found["answer"][-1] <= 10
    assert found["one grasp"] == 0 and 0 < found["mean"][NAME] < 20
    assert found["out of bounds"] == 422
    assert all(f'"{word}"' in found["openapi"] for word in (NAME, f"min_{NAME}", f"max_{NAME}", MEANING))


def test_the_dashboard_has_its_column_filter_and_distribution(found: Found) -> None:
    page = found["list"]
    assert f"sort={NAME}" in page and f'name="min_{NAME}"' in page and 'max="50"' in page
    assert TITLE in found["grasp page"] and TITLE in found["job page"]


def test_the_card_sums_it_up_and_the_docs_explain_it(found: Found) -> None:
    assert all(hand[NAME]["max"] == 20 for hand in found["card"].values())
    assert f"| {TITLE.lower()}, N | " in found["card's table"]
    assert f"| `quality/{NAME}` | (N) | f8 | N | none | {MEANING} *(may be absent)* |" in found["docs"]
