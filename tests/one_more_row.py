"""What is found of an option and of a metric where their tables have one row more than ours: `python -m
tests.one_more_row`.

A process of its own: what follows from a table is made when the modules that need it are imported. Arguments: a
folder, and the URL of an index that was made without the metric. Prints the findings as JSON.
"""

import inspect
import json
import sys
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from typing import Any

from graspd.service.model import metrics

NAME, TITLE, MEANING = "finger_force_n", "Finger force", "largest force of a finger"
METRIC = metrics.GraspMetric(
    NAME, "N", MEANING, title=TITLE, optional=True, indexed=metrics.IndexLevel.OFFERED, bounds=(0, 50), digits=1
)
OPTION, FLAG = "finger_force", "--finger-force"
ROW = f"""
    {OPTION}: Annotated[float, Option()] = _sparse_field(5.0, "{MEANING} [N]", ge=1, le=20)
"""
FORM_ROW = f'    "{OPTION}": FormField("Grasp", "Finger force", "of each finger", cells=True),\n'
#: The rows stand before the first rule of the options, and first in the table of the form.
_BEFORE = '\n    @field_validator("fidelity")'
_FORM = "FORM: Final[dict[str, FormField]] = {\n"


def add_rows() -> None:
    """Import the tables as if the rows stood in their files."""
    metrics.GRASP_METRICS = (*metrics.GRASP_METRICS, METRIC)  # type: ignore[misc]
    spec = find_spec("graspd.service.model.domain")
    assert spec is not None and spec.origin is not None
    source = Path(spec.origin).read_text()
    assert source.count(_BEFORE) == source.count(_FORM) == 1
    module = sys.modules[spec.name] = module_from_spec(spec)
    source = source.replace(_BEFORE, ROW + _BEFORE).replace(_FORM, _FORM + FORM_ROW)
    exec(compile(source, spec.origin, "exec"), module.__dict__)


def of_option(folder: Path) -> dict[str, Any]:
    from fastapi.testclient import TestClient
    from typer.testing import CliRunner

    import graspd
    from docs.tables import keywords_stub, options_table
    from graspd.api.app import create_app
    from graspd.cli import build_app
    from graspd.service.settings import Settings
    from tests.api.conftest import BASE_URL
    from tests.indexes import open_services

    def command(*words: str) -> str:
        return CliRunner().invoke(build_app(), [*words], env={"COLUMNS": "200"}).output

    calls, pair = (graspd.synthesize, graspd.Client.submit), ("--hand", "barrett", "--object", "block")
    services = open_services(Settings(data_dir=folder))
    with TestClient(create_app(services.settings, services), base_url=BASE_URL) as http:
        schemas = http.get("/openapi.json").json()["components"]["schemas"]
        found = {
            "help": [command(*name.split(), "--help") for name in ("synth", "submit", "datasets create")],
            "out of bounds": [
                command("synth", *pair, "-o", str(folder / "g.h5"), FLAG, "50"),
                command("submit", *pair, FLAG, "50"),
                http.post("/v1/jobs", json={"hand": "barrett", "object": "block", OPTION: 50}).json()["detail"],
            ],
            "forms": [http.get("/submit").text, http.get("/datasets").text],
            "http": [schemas[name]["properties"].get(OPTION) for name in ("JobRequest", "DatasetRequest")],
            "python": [str(inspect.signature(one).parameters.get(OPTION)) for one in calls],
            "types": keywords_stub(),
            "docs": options_table(),
            "warp": "warp" in sys.modules,
        }
    services.close()
    return found


def of_metric(folder: Path, older_index: str) -> dict[str, Any]:
    import numpy as np
    from fastapi.testclient import TestClient
    from sqlalchemy import inspect as inspected

    from docs.tables import schema_table
    from graspd.api.app import create_app
    from graspd.service.index.index import Index
    from graspd.service.model.states import Stage
    from graspd.service.store.columns import SCHEMAS
    from graspd.service.store.manifests import load_manifest
    from graspd.studies.cards.page import quality_table
    from tests.api.conftest import BASE_URL
    from tests.studies.test_cards import case

    def measured(hand: str, obj: str, columns: dict[str, Any]) -> None:
        columns[METRIC.path] = np.linspace(0, 20, len(columns["quality/valid"]))

    index = Index(older_index)
    before = [getattr(grasp, NAME) for grasp in index.grasps.page().items]
    index.close()
    made = case(folder, drawn=False, change=measured)
    services = made.services
    shard = next(shard.id for shard in made.snapshot.shards if shard.kind == "base")
    tables = inspected(services.index.database._engine)
    with TestClient(create_app(services.settings, services), base_url=BASE_URL) as http:
        query = {f"min_{NAME}": 5, f"max_{NAME}": 10, "sort": NAME, "order": "asc"}
        page = http.get("/v1/grasps", params=query).json()["items"]
        job = http.get("/v1/jobs").json()["items"][0]["id"]
        found = {
            "older index": before,
            "schema": SCHEMAS["base"][METRIC.path].description,
            "manifest": [getattr(one, NAME) for one in load_manifest(services.store, Stage.SYNTHESIZE, shard).grasps],
            "index columns": [column["name"] for column in tables.get_columns("grasps")],
            "index indexes": [one["name"] for one in tables.get_indexes("grasps")],
            "answer": [grasp[NAME] for grasp in page],
            "out of bounds": http.get("/v1/grasps", params={f"min_{NAME}": 51}).status_code,
            "mean": http.get(f"/v1/jobs/{job}").json()["mean"],
            "one grasp": http.get(f"/v1/grasps/{shard}/0").json()[NAME],
            "openapi": http.get("/openapi.json").text,
            "list": http.get("/grasps", params={"view": "table"}).text,
            "grasp page": http.get(f"/grasps/{shard}/0").text,
            "job page": http.get(f"/jobs/{job}").text,
            "card": made.card["quality"],
            "card's table": quality_table(made.card),
            "docs": schema_table("base"),
        }
    services.close()
    return found


if __name__ == "__main__":
    add_rows()
    folder = Path(sys.argv[1])
    print(json.dumps({"option": of_option(folder / "option"), "metric": of_metric(folder / "metric", sys.argv[2])}))
