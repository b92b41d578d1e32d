"""Readiness: an index that may lack jobs of the store says so."""

from __future__ import annotations

from fastapi import FastAPI
from starlette.testclient import TestClient

from graspd.api.app import create_app
from graspd.service.index.rebuild import rebuild
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from tests.api.factories import add_job
from tests.damage import overwrite
from tests.indexes import empty_index


def asked_anew(app: FastAPI) -> dict[str, object]:
    app.state.overview._probes._known = None
    with TestClient(app, base_url="http://127.0.0.1:8000") as http:
        answer = http.get("/readyz")
        return {"status": answer.status_code, **answer.json()["parts"]["index"]}


def test_an_index_that_lacks_what_the_store_has_is_not_ready(settings: Settings, services: Services) -> None:
    record = add_job(services)
    fresh = empty_index(f"sqlite:///{settings.data_dir / 'fresh.sqlite'}")
    lost = Services(settings, services.store, fresh, services.queue)
    app = create_app(settings, lost)
    fresh.write.add_job(record)
    assert (found := asked_anew(app))["status"] == 503
    assert not found["ok"]
    assert "controller" in str(found["detail"])
    rebuild(fresh, services.store)
    assert asked_anew(app)["status"] == 200
    fresh.close()


def test_an_index_without_damaged_records_names_them(settings: Settings, services: Services) -> None:
    key = f"jobs/{add_job(services).id}/job.json"
    app = create_app(settings, services)
    overwrite(services.store, key, b'{"x": 1}')
    rebuild(services.index, services.store)
    found = asked_anew(app)
    assert found["status"] == 200
    assert key in str(found["detail"])
