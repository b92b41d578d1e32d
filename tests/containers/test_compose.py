"""The images and the compose file with a real engine: `make test-containers`.

Takes minutes, and most of them go to the build. Where no engine is, or the base images cannot be had, it skips and says
so.
"""

import json
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import httpx
import pytest

from tests import waiting
from tests.containers.engine import NoEngine, Project, docker, look_for_engine
from tests.servers import free_ports
from tests.shell import completed

pytestmark = [pytest.mark.slow, pytest.mark.containers, pytest.mark.timeout(5400)]
BATCHES = 16
#: Generous: on two cores that have other work the kernels' first use alone takes a minute.
PATIENCE_S = 1800.0


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Project]:
    """The images built, with S3 and PostgreSQL as COMPOSE_PROFILES of `.env` asks."""
    try:
        look_for_engine()
    except NoEngine as reason:
        pytest.skip(str(reason))
    (port,) = free_ports(1)
    variables = {"COMPOSE_PROFILES": "cpu,s3,postgres", "GRASPD_VERSION": "test", "GRASPD_THREADS": "1"}
    variables |= {"GRASPD_PUBLISHED_PORT": str(port), "REDIS_PASSWORD": "redispassword"}
    variables |= {"GRASPD_STORE_URL": "s3://graspd", "AWS_ENDPOINT_URL": "http://s3:8333"}
    variables |= {"AWS_ACCESS_KEY_ID": "graspd", "AWS_SECRET_ACCESS_KEY": "s3password"}
    index = "postgresql+psycopg://graspd:postgrespassword@postgres:5432/graspd"
    variables |= {"POSTGRES_PASSWORD": "postgrespassword", "GRASPD_INDEX_URL": index}
    made = Project(tmp_path_factory.mktemp("project"), variables)
    try:
        made.build()
        yield made
    finally:
        made.close()


def until(met: Callable[[], object], what: str, project: Project, seconds: float = PATIENCE_S) -> None:
    waiting.until(met, what, seconds=seconds, logs=project.logs)


def is_healthy(project: Project, container: str) -> bool:
    return bool(project.looked_at(container)["State"]["Health"]["Status"] == "healthy")


def test_profiles_of_the_env_file_bring_s3_and_postgresql(project: Project) -> None:
    wanted = "api controller worker-cpu redis postgres s3"
    assert set(project.compose("config", "--services").split()) == set(wanted.split())


def test_any_user_plans_on_a_read_only_disk(project: Project) -> None:
    """No cache volume, no network, a user that the image does not know; it says where its cache is instead."""
    limits = "--network none --read-only --tmpfs /tmp:size=1g --user 4321:4321 --cap-drop ALL"
    wanted = "synth --hand allegro --object mug --grasps 2 --fidelity draft --out /tmp/out.h5"
    command = f"docker run --rm {limits} graspd-worker-cpu:test {wanted}"
    done = completed(command.split(), timeout=PATIENCE_S)
    said = done.stdout + done.stderr
    assert done.returncode == 0 and "Traceback" not in said, said[-3000:]
    assert "reproducible files are in /tmp/graspd-cache-4321" in said, said[-3000:]


def test_a_change_of_code_is_a_small_layer(project: Project) -> None:
    shown = ("--format", "{{.Size}} {{.CreatedBy}}", "--human=false")
    sizes = docker("history", *shown, "graspd-worker-cpu:test").splitlines()
    (code,) = (int(line.split()[0]) for line in sizes if "COPY /code" in line)
    (libraries,) = (int(line.split()[0]) for line in sizes if "COPY /opt/graspd /opt/graspd" in line)
    assert code < 40e6 < libraries


def test_a_job_over_http_outlives_two_killed_workers(project: Project) -> None:
    command = "run --rm -T --no-deps api keys add admin --scope admin --json"
    made = project.compose(*command.split())
    key = json.loads(made)["key"]
    project.compose("up", "-d", timeout=PATIENCE_S)
    project.compose("up", "-d", "--no-recreate", "--scale", "worker-cpu=4", timeout=PATIENCE_S)
    url = f"http://127.0.0.1:{project.variables['GRASPD_PUBLISHED_PORT']}"
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, trust_env=False, timeout=60) as client:

        def get(path: str) -> Any:
            try:
                answer = client.get(path)
            except httpx.HTTPError:
                return {}
            return answer.json() if answer.status_code == 200 else {}

        until(lambda: get("/readyz") and get("/v1/objects").get("items"), "the API has the objects", project)
        assert httpx.get(f"{url}/v1/jobs", trust_env=False).status_code == 401
        wanted = {"hand": "allegro", "object": "mug", "grasps": 32 * BATCHES, "fidelity": "draft"}
        wanted |= {"want": "candidates", "validation": "none"}
        job = client.post("/v1/jobs", json=wanted)
        assert job.status_code == 202, job.text
        place = job.headers["location"]

        def busy() -> list[str]:
            return [one["host"] for one in get("/v1/workers") if one["state"] == "busy"]

        until(lambda: len(busy()) >= 3, "workers are at work", project)
        for host in busy()[:2]:
            docker("kill", host)
        until(lambda: get(place).get("state") in ("succeeded", "failed", "cancelled"), "the job ends", project)
        assert get(place)["state"] == "succeeded", project.logs()

        detail = get(place)
        assert [one["kind"] for one in detail["attempts"]] in (["WorkerLost"], ["WorkerLost"] * 2)
        rows, page = [], {"job": place.rpartition("/")[2], "limit": "200"}
        while True:
            found = client.get("/v1/grasps", params=page).json()
            rows += found["items"]
            if not found.get("next"):
                break
            page["cursor"] = found["next"]
        assert len(rows) == 32 * BATCHES
        assert Counter((row["shard_id"], row["row"]) for row in rows).most_common(1)[0][1] == 1
        assert len({row["shard_id"] for row in rows}) == BATCHES

    # Both end with 1 where something differs, is damaged or is missing.
    project.compose("exec", "-T", "controller", "graspd", "admin", "index", "rebuild", "--check")
    project.compose("exec", "-T", "controller", "graspd", "admin", "store", "verify")
    for service in ("api", "controller", "worker-cpu", "redis", "postgres", "s3"):
        for container in project.containers(service):
            found = project.looked_at(container)
            until(partial(is_healthy, project, container), f"{service} is healthy", project, 300)
            if service in ("api", "controller", "worker-cpu"):
                assert found["HostConfig"]["ReadonlyRootfs"] and found["Config"]["User"] == "10001:10001"


def test_nothing_is_left(project: Project) -> None:
    project.close()
    for kind in ("container", "volume", "network"):
        assert docker(kind, "ls", "-q", "--filter", f"label=com.docker.compose.project={project.name}") == ""
