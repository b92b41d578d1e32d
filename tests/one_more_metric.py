"""What is found of a metric where the table has one row more than ours: `python -m tests.one_more_metric`.

A process of its own: what follows from the table is made when the modules that need it are imported. Arguments: a
folder, and the URL of an index that was made without the metric. Prints the findings as JSON.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from graspd.service.model import metrics

NAME, TITLE, MEANING = "finger_force_n", "Finger force", "largest force of a finger"
ROW = metrics.GraspMetric(
    NAME, "N", MEANING, title=TITLE, optional=True, indexed=metrics.IndexLevel.OFFERED, bounds=(0, 50), digits=1
)


def main(folder: Path, older_index: str) -> None:
    metrics.GRASP_METRICS = (*metrics.GRASP_METRICS, ROW)  # type: ignore[misc]
    from fastapi.testclient import TestClient
    from sqlalchemy import inspect

    from graspd.api.app import create_app
    from graspd.service.docs import schema_table
    from graspd.service.index.index import Index
    from graspd.service.model.states import Stage
    from graspd.service.store.columns import SCHEMAS
    from graspd.service.store.manifests import load_manifest
    from graspd.studies.cards.page import quality_table
    from tests.api.conftest import BASE_URL
    from tests.studies.test_cards import case

    def measured(hand: str, obj: str, columns: dict[str, Any]) -> None:
        columns[ROW.path] = np.linspace(0, 20, len(columns["quality/valid"]))

    index = Index(older_index)
    before = [getattr(grasp, NAME) for grasp in index.grasps.page().items]
    index.close()
    made = case(folder, drawn=False, change=measured)
    services = made.services
    shard = next(shard.id for shard in made.snapshot.shards if shard.kind == "base")
    engine = services.index.database._engine
    with TestClient(create_app(services.settings, services), base_url=BASE_URL) as http:
        query = {f"min_{NAME}": 5, f"max_{NAME}": 10, "sort": NAME, "order": "asc"}
        page = http.get("/v1/grasps", params=query).json()["items"]
        job = http.get("/v1/jobs").json()["items"][0]["id"]
        detail = http.get(f"/v1/grasps/{shard}/0").json()
        found = {
            "older index": before,
            "schema": SCHEMAS["base"][ROW.path].description,
            "manifest": [getattr(one, NAME) for one in load_manifest(services.store, Stage.SYNTHESIZE, shard).grasps],
            "index columns": [column["name"] for column in inspect(engine).get_columns("grasps")],
            "index indexes": [one["name"] for one in inspect(engine).get_indexes("grasps")],
            "answer": [grasp[NAME] for grasp in page],
            "out of bounds": http.get("/v1/grasps", params={f"min_{NAME}": 51}).status_code,
            "mean": http.get(f"/v1/jobs/{job}").json()["mean"],
            "one grasp": detail[NAME],
            "openapi": http.get("/openapi.json").text,
            "list": http.get("/grasps", params={"view": "table"}).text,
            "grasp page": http.get(f"/grasps/{shard}/0").text,
            "job page": http.get(f"/jobs/{job}").text,
            "card": made.card["quality"],
            "card's table": quality_table(made.card),
            "docs": schema_table("base"),
        }
    services.close()
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
