"""The compose file: pinned, in step with the settings, and its services end in time."""

import re
import subprocess

import pytest

from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.settings import Settings
from tests.conftest import REPOSITORY
from tests.deploy import composition
from tests.deploy.test_dockerfile import COMMANDS, IMAGES

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
