"""Options and metrics are declared once; messages name them as the caller spells them."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import trimesh

import graspd
from benchmarks.large_index import fill
from docs.tables import STUB, keywords_stub
from graspd.service.command_options import validate_options
from graspd.service.index.index import Index
from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.errors import InputError
from graspd.service.model.local_options import LocalOptions
from graspd.service.model.options import option_rows
from graspd.service.store.store import open_store
from tests.conftest import REPOSITORY
from tests.one_more_row import FLAG, MEANING, NAME, OPTION, TITLE
from tests.shell import completed


@pytest.mark.parametrize(
    ("wrong", "typed", "called"),
    [
        ({"grasps": 0}, "--grasps: ", "grasps: "),
        ({"neighbours": ["mug"] * 9}, "--with: ", "neighbours: "),
        ({"options": "steps"}, "--option: ", "options: "),
        ({"min_payload": -1}, "--min-payload: ", "min_payload: "),
        ({"payload": "perhaps"}, "--payload: ", "payload: "),
        ({"join": "many"}, "--join: must be a number of batches from 1 to 9999, or auto; got 'many'", "join: must be"),
        ({"friction": 9}, "--friction: ", "friction: must be more than 0 and at most 3; got 9"),
        ({"fidelity": "paint"}, "--fidelity: unknown fidelity 'paint'; choose one of", "fidelity: unknown"),
        ({"threads": -1}, "--threads: ", "threads: must be at least 0; got -1"),
    ],
)
def test_every_message_is_in_the_words_of_the_caller(wrong: dict[str, Any], typed: str, called: str) -> None:
    with pytest.raises(InputError) as refused:
        validate_options(LocalOptions, wrong)
    assert str(refused.value).startswith(typed)
    with pytest.raises(InputError) as refused:
        graspd.synthesize("barrett", "block", **wrong)
    assert str(refused.value).startswith(called)


def test_a_fix_is_in_the_words_of_the_caller(tmp_path: Path) -> None:
    trimesh.creation.box((60, 60, 60)).export(tmp_path / "box.stl")
    with pytest.raises(graspd.MeshError, match=r"; units mm makes it .*scale_to 0\.1") as refused:
        graspd.synthesize("barrett", tmp_path / "box.stl")
    assert "--" not in str(refused.value) and refused.value.facts["options_suggested"]  # type: ignore[attr-defined]


def test_a_keyword_that_is_none_is_a_type_error() -> None:
    with pytest.raises(TypeError, match=r"^synthesize\(\) got an unexpected keyword argument 'views'$"):
        graspd.synthesize("barrett", "block", views=3)  # type: ignore[call-arg]


def test_fields_of_jobs_options_and_types_of_keywords_are_the_same() -> None:
    assert {row.name for row in option_rows(JobRequest, "job")} == set(JobOptions.model_fields)
    assert (REPOSITORY / STUB).read_text() == keywords_stub(), "run: make docs"


@pytest.mark.parametrize("kind", [str, Path])
def test_an_option_of_the_planner_may_be_a_file_with_a_long_path(kind: type, tmp_path: Path) -> None:
    file = kind(tmp_path / f"{'x' * 100}.npz")
    with pytest.raises(InputError, match=r"xxx\.npz"):
        graspd.synthesize("barrett", "mug", scene="table", method="learned", options={"network": file})
    with pytest.raises(InputError, match=r"^options\.steps: must"):
        graspd.synthesize("barrett", "mug", method="graspit", options={"steps": "x" * 100})


Found = dict[str, Any]


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Found]:
    folder = tmp_path_factory.mktemp("rows")
    older = f"sqlite:///{folder / 'older.sqlite'}"
    index = Index(older)
    fill(index, open_store("memory://"), grasps=64, jobs=2)
    index.close()
    for name in ("option", "metric"):
        (folder / name).mkdir()
    done = completed([sys.executable, "-m", "tests.one_more_row", folder, older], cwd=REPOSITORY)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.splitlines()[-1]))


@pytest.fixture
def found(both: dict[str, Found]) -> Found:
    return both["metric"]


def test_one_more_option_is_found_in_all_places(both: dict[str, Found]) -> None:
    found = both["option"]
    assert all(FLAG in text and f"{MEANING} [N]".removeprefix("largest ") in text for text in found["help"])
    assert [text.strip() for text in found["out of bounds"][:2]] == [
        f"graspd: {FLAG}: must be at most 20; see `root {name} --help`" for name in ("synth", "submit")
    ]
    assert OPTION in found["out of bounds"][2]
    for page, place in zip(found["forms"], ("", "cell-"), strict=True):
        assert f'<label for="{place}{OPTION}">Finger force [N]</label>' in page
        assert f'name="{OPTION}" type="number" min="1" max="20" step="any" value="5"' in page
    shown = {"type": "number", "maximum": 20.0, "minimum": 1.0, "title": "Finger Force", "default": 5.0}
    assert found["http"] == [shown | {"description": f"{MEANING} [N]"}] * 2
    assert found["python"] == [f"{OPTION}: 'float' = 5.0"] * 2
    assert found["types"].count(f"    {OPTION}: float\n") == 2
    assert f"| `{OPTION}` | `{FLAG}` | both | `5.0` | at least 1 and at most 20 | {MEANING} [N] |" in found["docs"]
    assert not found["warp"], "help, completion and what is refused need no engine"


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
    assert f"sort={NAME}" in page and f'name="min_{NAME}"' in page and 'max="20"' in page
    assert TITLE in found["grasp page"] and TITLE in found["job page"]


def test_the_card_sums_it_up_and_the_docs_explain_it(found: Found) -> None:
    assert all(hand[NAME]["max"] == 20 for hand in found["card"].values())
    assert f"| {TITLE.lower()}, N | " in found["card's table"]
    assert f"| `quality/{NAME}` | (N) | f8 | N | none | {MEANING} *(may be absent)* |" in found["docs"]
