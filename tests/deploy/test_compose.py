"""The compose file; its services as processes of this machine, and docker/nginx.conf before a real API."""

import os
import re
import shutil
import signal
import ssl
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import httpx
import pytest
import redis

from graspd.api.access.keys import KeyFile, Scope
from graspd.service.index.index import Index
from graspd.service.index.rebuild import differences
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.queue.connection import connect
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.run.embedded import find_server
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.api.factories import bearer
from tests.conftest import REPOSITORY
from tests.deploy import composition
from tests.deploy.test_dockerfile import COMMANDS, IMAGES
from tests.servers import PostgresServer, S3Server, free_ports
from tests.service.conftest import wait_for_redis
from tests.shell import completed
from tests.waiting import answers, until

NAME = "grasps.example.org"


@dataclass
class Topology:
    folder: Path
    variables: dict[str, str]
    redis_port: int
    ports: list[int]
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def environment(self, service: str) -> dict[str, str]:
        found = composition.load(self.variables)["services"][service]
        return composition.environment(found, self.folder / "data", {"redis:6379": f"127.0.0.1:{self.redis_port}"})

    def start(self, name: str, service: str, *command: str, **more: str) -> None:
        place = {"env": self.environment(service) | more, "cwd": REPOSITORY}
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen([sys.executable, "-m", *command], stdout=log, stderr=log, **place)

    def graspd(self, service: str, *arguments: str, **more: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "graspd", *arguments]
        return completed(command, env=self.environment(service) | more, cwd=REPOSITORY)

    def until_ready(self) -> None:
        urls = [f"http://127.0.0.1:{port}/readyz" for port in self.ports]
        until(lambda: all(map(answers, urls)), "both APIs are ready", logs=self.logs)

    def stop(self) -> None:
        for process in self.processes.values():
            process.send_signal(signal.SIGTERM)
        for process in self.processes.values():
            try:
                process.wait(timeout=30)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def logs(self) -> str:
        return "\n".join(f"--- {log.name}\n{log.read_text()[-1500:]}" for log in sorted(self.folder.glob("*.log")))


@pytest.fixture
def topology(tmp_path: Path, s3_server: S3Server, postgres_server: PostgresServer) -> Iterator[Topology]:
    redis_port, *ports = free_ports(3)
    variables = {
        "REDIS_PASSWORD": "a-password",
        "GRASPD_STORE_URL": f"s3://{s3_server.bucket}/{tmp_path.name}",
        "GRASPD_INDEX_URL": postgres_server.database(),
        **s3_server.environment,
    }
    made = Topology(tmp_path, variables, redis_port, ports)
    (tmp_path / "redis").mkdir()
    service = composition.load(variables)["services"]["redis"]
    command = composition.redis_command(service, find_server()[0], redis_port, tmp_path / "redis")
    made.processes["redis"] = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        yield made
    finally:
        redis = made.processes.pop("redis")
        made.stop()
        redis.terminate()
        redis.wait(timeout=30)


@pytest.mark.s3
@pytest.mark.postgres
def test_services_of_the_compose_file_do_a_job_together(topology: Topology, monkeypatch: pytest.MonkeyPatch) -> None:
    made = topology.graspd("api", "keys", "add", "admin", "--scope", "admin")
    assert made.returncode == 0, made.stderr
    headers = bearer(made.stdout.split()[0])
    for number, port in enumerate(topology.ports):
        topology.start(f"api-{number}", "api", "graspd", "api", GRASPD_PORT=str(port))
    topology.start("controller", "controller", "graspd", "controller")
    for number in range(2):
        topology.start(f"worker-{number}", "worker-cpu", "tests.fakes", GRASPD_DEVICE="cpu")
    topology.until_ready()
    urls = [f"http://127.0.0.1:{port}" for port in topology.ports]
    first, second = (httpx.Client(base_url=url, headers=headers, trust_env=False, timeout=60) for url in urls)
    with first, second:
        assert httpx.get(f"{first.base_url}/v1/jobs", trust_env=False, timeout=60).status_code == 401
        # The controller publishes what comes with graspd.
        until(lambda: first.get("/v1/objects").json()["items"], "objects are there")
        job = first.post("/v1/jobs", json={"hand": "allegro", "object": "mug", "grasps": 128, "scenes": 1})
        assert job.status_code == 202, job.text
        until(lambda: second.get(job.headers["location"]).json()["state"] == "succeeded", "the job ends")
        assert second.get("/v1/stats").json()["grasps"] == 128
    assert topology.graspd("controller", "controller", "--check").returncode == 0
    assert topology.graspd("worker-cpu", "worker", "--check").returncode == 0
    for name, value in topology.environment("api").items():
        monkeypatch.setenv(name, value)
    with closing(Index(topology.variables["GRASPD_INDEX_URL"])) as index:
        assert differences(index, open_store(topology.variables["GRASPD_STORE_URL"])) == []


def test_redis_refuses_those_without_the_password(tmp_path: Path) -> None:
    (port,) = free_ports(1)
    service = composition.SERVICES["redis"]
    command = composition.redis_command(service, find_server()[0], port, tmp_path)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        queue = RqQueue(connect(f"redis://:secret@127.0.0.1:{port}/0", patience=0))
        try:
            wait_for_redis(queue)
            assert queue.connection.config_get("appendonly") == {"appendonly": "yes"}
            assert queue.connection.config_get("maxmemory-policy") == {"maxmemory-policy": "noeviction"}
            with redis.Redis(port=port) as stranger, pytest.raises(redis.AuthenticationError):
                stranger.ping()
        finally:
            queue.close()
            process.terminate()
    assert (tmp_path / "appendonlydir").is_dir()


def served(folder: Path, api: int, plain: int, secure: int) -> Path:
    make = f"openssl req -x509 -newkey rsa:2048 -nodes -days 1 -subj /CN={NAME} -addext subjectAltName=DNS:{NAME}"
    files = ["-keyout", str(folder / "key.pem"), "-out", str(folder / "cert.pem")]
    subprocess.run([*make.split(), *files], check=True, capture_output=True)
    text = (REPOSITORY / "docker" / "nginx.conf").read_text()
    for old, new in {
        "listen 80;": f"listen 127.0.0.1:{plain};",
        "listen 443 ssl;": f"listen 127.0.0.1:{secure} ssl;",
        f"/etc/ssl/certs/{NAME}.pem": str(folder / "cert.pem"),
        f"/etc/ssl/private/{NAME}.key": str(folder / "key.pem"),
        "127.0.0.1:8000": f"127.0.0.1:{api}",
    }.items():
        assert old in text
        text = text.replace(old, new)
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    temporary = "".join(f"{kind}_temp_path {folder}/{kind};\n" for kind in kinds)
    path = folder / "nginx.conf"
    path.write_text(
        f"user root;\npid {folder}/pid;\nerror_log {folder}/error.log;\nevents {{}}\n"
        f"http {{ access_log off;\n{temporary}{text} }}\n"
    )
    return path


class Proxy(NamedTuple):
    """A client that believes the proxy's certificate, a key of the API behind it, the name and port it goes by."""

    client: httpx.Client
    key: str
    host: str
    plain_port: int


@pytest.fixture(scope="module")
def proxy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Proxy]:
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
    if program is None or shutil.which("openssl") is None:
        pytest.skip("nginx or openssl is not installed: `apt-get install nginx-light openssl`")
    folder = tmp_path_factory.mktemp("proxy")
    api, plain, secure = free_ports(3)
    key = KeyFile(folder / "data" / "keys.json").add("admin", Scope.ADMIN)
    environment = os.environ | {"GRASPD_DATA_DIR": str(folder / "data"), "GRASPD_PORT": str(api)}
    environment |= {"FORWARDED_ALLOW_IPS": "127.0.0.1"}
    configuration = served(folder, api, plain, secure)
    with (folder / "api.log").open("wb") as log:
        started = [
            subprocess.Popen([sys.executable, "-m", "graspd", "api"], env=environment, cwd=REPOSITORY, stderr=log),
            subprocess.Popen([program, "-c", str(configuration), "-g", "daemon off;"], stderr=log),
        ]
    trust = ssl.create_default_context(cafile=str(folder / "cert.pem"))
    # The certificate is for the name, the address is loopback's.
    client = httpx.Client(
        base_url=f"https://127.0.0.1:{secure}",
        headers={"Host": f"{NAME}:{secure}"},
        verify=trust,
        trust_env=False,
        timeout=60,
        event_hooks={"request": [lambda request: request.extensions.update(sni_hostname=NAME)]},
    )
    try:
        is_up = lambda: answers("/healthz", client)  # noqa: E731
        until(is_up, "the API answers through the proxy", logs=(folder / "api.log").read_text)
        yield Proxy(client, key, f"{NAME}:{secure}", plain)
    finally:
        client.close()
        for process in started:
            process.terminate()
        for process in started:
            process.wait(timeout=60)


def test_a_key_opens_the_api_through_tls_where_plain_http_is_sent(proxy: Proxy) -> None:
    assert proxy.client.get("/v1/jobs").status_code == 401
    answer = proxy.client.get("/v1/jobs", headers={"Authorization": f"Bearer {proxy.key}"})
    assert answer.status_code == 200, answer.text
    assert "max-age" in answer.headers["strict-transport-security"]
    plain = f"http://127.0.0.1:{proxy.plain_port}/jobs"
    answer = httpx.get(plain, headers={"Host": NAME}, trust_env=False, timeout=60)
    assert answer.status_code == 301 and answer.headers["location"] == f"https://{NAME}/jobs"


def test_a_browser_signs_in_through_the_proxy(proxy: Proxy) -> None:
    assert proxy.client.get("/login").status_code == 200
    own = {"Origin": f"https://{proxy.host}", "Sec-Fetch-Site": "same-origin"}
    answer = proxy.client.post("/login", data={"key": proxy.key}, headers=own)
    assert answer.status_code == 303, answer.text
    assert re.search("HttpOnly", answer.headers["set-cookie"], re.IGNORECASE)
    answer = proxy.client.post("/login", data={"key": proxy.key}, headers={"Origin": "https://elsewhere.example"})
    assert answer.status_code == 403


FILLED = {"REDIS_PASSWORD": "secret"}
SERVICES = composition.SERVICES
OURS = sorted(name for name, service in SERVICES.items() if "build" in service)
SETTINGS = {f"GRASPD_{name.upper()}" for name in Settings.model_fields}
PREFIXES = ("AWS_", "REDIS_", "REDISCLI_", "POSTGRES_", "FORWARDED_")


def test_gpu_workers_see_every_gpu_and_share_a_folder() -> None:
    """With `count: 1` Docker gives each of them the first GPU."""
    gpu = composition.load(FILLED | {"GRASPD_GPU_WORKERS": "4"})["services"]["worker-gpu"]
    (devices,) = gpu["deploy"]["resources"]["reservations"]["devices"]
    assert (gpu["deploy"]["replicas"], devices["count"]) == ("4", "all")
    assert "cache:/var/cache/graspd" in gpu["volumes"] and "GRASPD_DEVICE" not in gpu["environment"]


@pytest.mark.parametrize("name", sorted(SERVICES))
def test_every_service_has_a_version_limits_and_bounded_logs(name: str) -> None:
    service = SERVICES[name]
    assert re.match(r"v?\d", service["image"].partition(":")[2]), f"{service['image']} floats"
    assert "memory" in service["deploy"]["resources"]["limits"] and service["restart"] == "unless-stopped"
    assert {"max-size", "max-file"} <= service["logging"]["options"].keys()


@pytest.mark.parametrize("name", OURS)
def test_the_environment_is_made_of_settings_that_can_be_read(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    environment = SERVICES[name]["environment"]
    assert not {key for key in environment if key not in SETTINGS and not key.startswith(PREFIXES)}
    for key, value in environment.items():
        monkeypatch.setenv(key, value)
    settings = Settings()
    assert settings.redis_url is not None
    assert settings.index_url is None, "an empty variable is an unset one"


@pytest.mark.parametrize("name", OURS)
def test_our_containers_have_no_rights_and_time_to_stop(name: str) -> None:
    service = SERVICES[name]
    grace = max(float(one["GRASPD_STOP_GRACE_S"]) for one in (service["environment"], composition.example()))
    assert composition.seconds(service["stop_grace_period"]) > grace
    assert (service["read_only"], service["cap_drop"]) == (True, ["ALL"])
    assert "no-new-privileges:true" in service["security_opt"]
    assert service["image"].endswith(f":{PACKAGE_VERSION}")
    assert service["build"]["target"] in IMAGES
    assert service["command"][0] in COMMANDS


def test_volumes_ports_and_password_are_named_and_private() -> None:
    used = {volume.partition(":")[0] for service in SERVICES.values() for volume in service.get("volumes", ())}
    assert used == composition.load(FILLED)["volumes"].keys()
    ports = [port for service in SERVICES.values() for port in service.get("ports", ())]
    assert ports and all(port.startswith("127.0.0.1:") for port in ports)
    with pytest.raises(KeyError, match="REDIS_PASSWORD"):
        composition.load({})


@pytest.mark.parametrize("name", sorted(SERVICES))
def test_it_waits_for_services_that_tell_their_health(name: str) -> None:
    for other, wanted in SERVICES[name].get("depends_on", {}).items():
        assert other in SERVICES
        # Images of ours have a health check of their own.
        if wanted["condition"] == "service_healthy":
            assert "healthcheck" in SERVICES[other] or "build" in SERVICES[other]
        needs_profile = set(SERVICES[other].get("profiles", ())) - set(SERVICES[name].get("profiles", ()))
        assert wanted.get("required", True) is not bool(needs_profile), "a part that may be absent is not required"


def test_the_example_names_what_the_file_asks_for() -> None:
    asked = composition.names_asked_for(composition.COMPOSE.read_text())
    example = composition.example().keys()
    assert example - {"COMPOSE_PROFILES"} <= asked, "a variable of the example has no effect"
    # The rest has a default that fits everybody.
    assert {name for name in asked - example if name not in SETTINGS and name not in {"AWS_REGION"}} == set()
    profiles = {profile for service in SERVICES.values() for profile in service.get("profiles", ())}
    assert profiles == {"cpu", "gpu", "s3", "postgres"}
    assert set(composition.example()["COMPOSE_PROFILES"].split(",")) <= profiles
    assert composition.example()["GRASPD_VERSION"] == PACKAGE_VERSION


@pytest.mark.parametrize("page", ["docker-compose.yml", ".env.example", "README.md", "docs/how-to/install.md"])
def test_profiles_are_named_in_one_place(page: str) -> None:
    """`docker compose --profile cpu` would drop those that COMPOSE_PROFILES in .env asks for."""
    assert "--profile " not in (REPOSITORY / page).read_text()


def test_secrets_stay_out_of_the_repository() -> None:
    for name, value in composition.example().items():
        if name.endswith(("PASSWORD", "SECRET_ACCESS_KEY")):
            assert value == "", f"{name} has a value that everybody would keep"
    ignored = subprocess.run(["git", "check-ignore", "-q", ".env"], cwd=REPOSITORY, check=False)
    assert ignored.returncode == 0, ".env may be committed by mistake"


@pytest.mark.parametrize("name", [name for name in OURS if name.startswith("worker")])
def test_a_worker_makes_room_before_its_container_is_killed(name: str) -> None:
    limit_gb = int(SERVICES[name]["deploy"]["resources"]["limits"]["memory"].removesuffix("G"))
    assert int(SERVICES[name]["environment"]["GRASPD_WORKER_MAX_MEMORY_MB"]) < 1000 * limit_gb
