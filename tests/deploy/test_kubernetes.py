"""The manifests and batch scripts: valid, in step with settings, images and queue; nothing ends a busy worker."""

import functools
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

import graspd.cli
from graspd.service.model.states import Priority, Stage
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.queue.entries import queue_name
from graspd.service.settings import Settings
from tests.conftest import REPOSITORY
from tests.deploy.composition import SERVICES, seconds
from tests.deploy.slurm import directives
from tests.deploy.test_compose import SETTINGS
from tests.deploy.test_dockerfile import COMMANDS
from tests.shell import completed

FOLDER = REPOSITORY / "docker" / "kubernetes"
VARIANTS = ("fixed-cpu", "fixed-gpu", "keda-cpu", "keda-gpu")
#: What health checks run: a look at the age of a file, no process of ours.
AGE_OF_THE_FILE = 'test -n "$(find "$GRASPD_HEARTBEAT_FILE" -mmin -1)"'
Document = dict[str, Any]
#: Fields that KEDA 2.14 and later document; its own schemas come with no package.
SCALED_JOB = {"jobTargetRef", "pollingInterval", "minReplicaCount", "maxReplicaCount", "successfulJobsHistoryLimit"}
SCALED_JOB |= {"failedJobsHistoryLimit", "rollout", "scalingStrategy", "triggers"}
REDIS_LIST = {"address", "listName", "listLength", "activationListLength", "databaseIndex", "enableTLS"}
BURST = FOLDER / "burst.yaml"
SLURM = REPOSITORY / "docker" / "slurm"
PAGE = (REPOSITORY / "docs" / "how-to" / "clusters.md").read_text()
FILES = [BURST, *sorted(SLURM.iterdir())]


@functools.cache
def _files() -> dict[str, list[Document]]:
    found = {}
    for path in sorted(FOLDER.rglob("*.yaml")):
        if path.name not in ("kustomization.yaml", "images.yaml"):
            found[str(path.relative_to(FOLDER))] = list(yaml.safe_load_all(path.read_text()))
    return found


def documents(*kinds: str) -> list[Document]:
    return [found for file in _files().values() for found in file if not kinds or found["kind"] in kinds]


def job_template(found: Document) -> Document:
    return found["spec"]["jobTargetRef"]


def templates(*kinds: str) -> Iterator[tuple[str, Document]]:
    for found in documents(*kinds):
        holder = job_template(found) if found["kind"] == "ScaledJob" else found["spec"]
        yield found["metadata"]["name"], holder["template"]


def pods() -> list[tuple[str, Document]]:
    return [(name, template["spec"]) for name, template in templates("Deployment", "StatefulSet", "ScaledJob")]


def containers() -> list[tuple[str, Document]]:
    return [(name, container) for name, pod in pods() for container in pod["containers"]]


def rendered(variant: str) -> list[Document]:
    if shutil.which("kubectl") is None:
        pytest.skip("kubectl is not installed")
    done = completed(["kubectl", "kustomize", str(FOLDER / variant)])
    assert done.returncode == 0, done.stderr
    return list(yaml.safe_load_all(done.stdout))


@pytest.mark.parametrize("version", ["1.30.0", "1.34.0"])
def test_documents_and_pods_of_keda_are_what_kubernetes_takes(version: str) -> None:
    for found in documents():
        if not found["apiVersion"].startswith("keda.sh/"):
            kubernetes_validate.validate(found, version, strict=True)
    for found in documents("ScaledJob"):
        spec = job_template(found) | {"parallelism": 1}
        job = {"apiVersion": "batch/v1", "kind": "Job", "metadata": {"name": "worker"}, "spec": spec}
        kubernetes_validate.validate(job, version, strict=True)


def test_the_documents_of_keda_hold_only_fields_that_keda_has() -> None:
    for found in documents("ScaledJob"):
        spec = found["spec"]
        assert spec.keys() <= SCALED_JOB
        assert spec["scalingStrategy"].keys() == {"strategy", "multipleScalersCalculation"}
        for trigger in spec["triggers"]:
            assert trigger.keys() == {"type", "metadata", "authenticationRef"} and trigger["type"] == "redis"
            assert {"address", "listName", "listLength"} <= trigger["metadata"].keys() <= REDIS_LIST
            assert all(isinstance(value, str) for value in trigger["metadata"].values()), "as KEDA wants them"
    for found in documents("TriggerAuthentication"):
        (secret,) = found["spec"]["secretTargetRef"]
        assert secret.keys() == {"parameter", "name", "key"} and secret["parameter"] == "password"


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_variant_is_rendered_with_all_images_pinned(variant: str) -> None:
    images = re.findall(r"image: (\S+)", yaml.safe_dump_all(rendered(variant)))
    assert images and [image for image in images if not re.search(r":v?\d+\.\d+\.\d+", image)] == []
    assert {image.partition(":")[2] for image in images if image.startswith("graspd-")} == {PACKAGE_VERSION}


@pytest.mark.parametrize("variant", ["keda-cpu", "keda-gpu"])
def test_every_list_of_the_queue_starts_a_worker_that_serves_it(variant: str) -> None:
    served: set[str] = set()
    for found in rendered(variant):
        if found["kind"] != "ScaledJob":
            continue
        arguments = job_template(found)["template"]["spec"]["containers"][0]["args"]
        at = arguments.index("--stages") + 1 if "--stages" in arguments else None
        stages = arguments[at].split(",") if at else list(Stage)
        own = {f"rq:queue:{queue_name(priority, Stage(stage))}" for priority in Priority for stage in stages}
        assert {trigger["metadata"]["listName"] for trigger in found["spec"]["triggers"]} == own
        served |= own
    assert served == {f"rq:queue:{queue_name(priority, stage)}" for priority in Priority for stage in Stage}


def test_nothing_ends_a_worker_that_is_busy() -> None:
    jobs = documents("ScaledJob")
    assert jobs
    for found in jobs:
        # The lists do not hold running tasks: `default` would take them off a second time.
        assert found["spec"]["scalingStrategy"]["strategy"] == "accurate"
        assert found["spec"]["rollout"] == {"strategy": "gradual"}, "a change leaves running jobs alone"
        job = job_template(found)
        assert "activeDeadlineSeconds" not in job
        assert "--burst" in job["template"]["spec"]["containers"][0]["args"], "the worker ends by itself"
        annotations = job["template"]["metadata"]["annotations"]
        assert annotations["cluster-autoscaler.kubernetes.io/safe-to-evict"] == "false"
    assert not documents("ScaledObject", "HorizontalPodAutoscaler"), "they end pods without asking who is busy"


def test_a_second_controller_takes_over_where_the_first_is_lost() -> None:
    (controller,) = [found for found in documents("Deployment") if found["metadata"]["name"] == "controller"]
    spec = controller["spec"]
    rolling = spec["strategy"]["rollingUpdate"]
    assert (spec["replicas"], rolling["maxUnavailable"]) == (2, 1), "one leads while the other is exchanged"
    environment = {one["name"]: one for one in spec["template"]["spec"]["containers"][0]["env"]}
    named = environment["GRASPD_CONTROLLER_NAME"]["valueFrom"]["fieldRef"]["fieldPath"]
    assert named == "metadata.name", "two under one name would both lead"
    budgets = [found["spec"]["selector"] for found in documents("PodDisruptionBudget")]
    assert spec["selector"] in budgets, "a drain of two nodes takes one after the other"


def test_the_environment_can_be_read_and_leaves_a_process_time_to_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    (settings,) = documents("ConfigMap")
    given = set(settings["data"]) | {entry["name"] for _, container in containers() for entry in container["env"]}
    assert {name for name in given if name.startswith("GRASPD_")} <= SETTINGS
    foreign = {name for name in given if not name.startswith("GRASPD_")}
    assert foreign <= {"AWS_REGION", "REDIS_PASSWORD", "REDISCLI_AUTH"}
    for name, value in settings["data"].items():
        assert isinstance(value, str), f"{name}: Kubernetes takes strings only"
        monkeypatch.setenv(name, value)
    Settings()
    for name, pod in pods():
        assert pod["terminationGracePeriodSeconds"] > float(settings["data"]["GRASPD_STOP_GRACE_S"]), name


def test_no_secret_is_written_down() -> None:
    assert not documents("Secret")
    for _, container in containers():
        for entry in container["env"]:
            if re.search("PASSWORD|SECRET|AUTH|INDEX_URL", entry["name"]):
                assert "secretKeyRef" in entry["valueFrom"], entry["name"]


def test_every_reference_to_a_secret_is_one_that_the_docs_make() -> None:
    named = set(re.findall(r"(graspd-(?:redis|index|store|keys))\b", yaml.safe_dump_all(documents())))
    page = (REPOSITORY / "docs" / "how-to" / "install.md").read_text()
    assert named == {name for name in named if f"secret generic {name}" in page}


@pytest.mark.parametrize("name", sorted({name for name, _ in pods()}))
def test_a_pod_has_no_rights_to_lose(name: str) -> None:
    for pod in (pod for found, pod in pods() if found == name):
        assert pod["automountServiceAccountToken"] is False and pod["securityContext"]["runAsNonRoot"] is True
        for container in pod["containers"]:
            rights = container["securityContext"]
            assert rights["readOnlyRootFilesystem"] is True and rights["allowPrivilegeEscalation"] is False
            assert rights["capabilities"] == {"drop": ["ALL"]}
            assert "memory" in container["resources"]["limits"]


def test_containers_run_commands_that_exist() -> None:
    for name, container in containers():
        if container["image"].startswith("graspd-"):
            assert container["args"][0] in COMMANDS, name


def test_the_probes_are_routes_and_checks_that_exist() -> None:
    from graspd.api.routes.system import router

    routes = {route.path for route in router.routes}
    for _, container in containers():
        for kind in ("startupProbe", "livenessProbe", "readinessProbe"):
            probe = container.get(kind, {})
            if "httpGet" in probe:
                assert probe["httpGet"]["path"] in routes
            elif probe and container["image"].startswith("graspd-"):
                assert probe["exec"]["command"][-1] == AGE_OF_THE_FILE
    (api,) = [container for name, container in containers() if name == "api"]
    assert api["livenessProbe"]["httpGet"]["path"] == "/healthz", "it is not restarted because a part is away"
    assert api["readinessProbe"]["httpGet"]["path"] == "/readyz"


@pytest.mark.parametrize("name", sorted({name for name, _ in pods()} - {"api", "redis"}))
def test_a_controller_or_worker_that_hangs_is_started_again(name: str) -> None:
    for found, container in containers():
        if found == name:
            assert container["livenessProbe"]["periodSeconds"] * container["livenessProbe"]["failureThreshold"] >= 60
            assert container["startupProbe"]["failureThreshold"] * container["startupProbe"]["periodSeconds"] >= 300


def test_every_kind_of_worker_has_a_disruption_budget() -> None:
    budgets = [found["spec"] for found in documents("PodDisruptionBudget")]
    for found in documents("Deployment", "ScaledJob"):
        name = found["metadata"]["name"]
        if name.startswith("worker"):
            own = [b for b in budgets if b["selector"]["matchLabels"] == {"app.kubernetes.io/name": name}]
            assert own
            # Kubernetes takes no share of pods that have no size to take it of.
            assert found["kind"] == "Deployment" or any(isinstance(budget.get("minAvailable"), int) for budget in own)


def test_everything_is_shut_but_identities_of_the_cloud_by_name() -> None:
    policies = {found["metadata"]["name"]: found["spec"] for found in documents("NetworkPolicy")}
    assert policies["nothing-else"] == {"podSelector": {}, "policyTypes": ["Ingress", "Egress"]}
    blocks = [to["ipBlock"]["cidr"] for rule in policies["to-identity"]["egress"] for to in rule["to"]]
    assert all(block.startswith("169.254.") and block.endswith("/32") for block in blocks)
    component = yaml.safe_load((FOLDER / "cloud-identity" / "kustomization.yaml").read_text())
    assert component["kind"] == "Component", "nobody gets it unasked"


def test_workers_reach_no_database() -> None:
    (to_index,) = [found for found in documents("NetworkPolicy") if found["metadata"]["name"] == "to-index"]
    allowed = to_index["spec"]["podSelector"]["matchLabels"]
    for name, template in templates("Deployment", "ScaledJob"):
        assert (allowed.items() <= template["metadata"]["labels"].items()) is not name.startswith("worker"), name


def test_compose_and_kubernetes_run_the_same_redis() -> None:
    (redis,) = [container for name, container in containers() if name == "redis"]
    assert redis["image"] == SERVICES["redis"]["image"]
    assert seconds(SERVICES["redis"]["stop_grace_period"]) == 30
    options = {"--appendonly", "--appendfsync", "--maxmemory", "--maxmemory-policy", "--requirepass"}
    assert options <= set(redis["args"]) & set(SERVICES["redis"]["command"])


def test_a_worker_makes_room_before_its_pod_is_killed_for_memory() -> None:
    workers = [container for _, container in containers() if container["args"][0] == "worker"]
    assert workers
    for container in workers:
        limit_gb = int(container["resources"]["limits"]["memory"].removesuffix("Gi"))
        values = {entry["name"]: entry.get("value") for entry in container["env"]}
        assert int(values["GRASPD_WORKER_MAX_MEMORY_MB"]) < 1000 * limit_gb


def options_of(command: str) -> set[str]:
    module = next(module for name, module, *_ in graspd.cli.COMMANDS if name == command)
    loaded: Any = graspd.cli.load_command(module, command)
    return {option for parameter in loaded.params for option in parameter.opts}


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_every_file_uses_settings_and_options_that_exist(file: Path) -> None:
    assert f"docker/{file.parent.name}/{file.name}" in PAGE
    text = file.read_text()
    # `GRASPD=` is the command itself.
    assert set(re.findall(r"\bGRASPD_[A-Z_]+\b", text)) - {"GRASPD_"} <= SETTINGS
    for command in ("worker", "up", "doctor"):
        by_name, by_variable = rf"\bgraspd {command} ([^|;`)\n]*)", rf'"\${{graspd\[@\]}}" {command} (.*)'
        for call in re.findall(f"{by_name}|{by_variable}", text.replace("\\\n", " ")):
            assert set(re.findall(r"(?<![\w-])--[a-z-]+", " ".join(call))) <= options_of(command), call
    for found in re.findall(r"\[(worker, --burst[^\]]*)\]", text):
        words = [word.strip(" '\"") for word in found.split(",")]
        assert {word for word in words if word.startswith("--")} <= options_of("worker")


@pytest.mark.parametrize("script", ["service.sbatch", "worker.sbatch"])
def test_a_batch_script_is_shell_and_asks_for_what_slurm_knows(script: str) -> None:
    subprocess.run(["bash", "-n", SLURM / script], check=True)
    wanted = directives(SLURM / script)
    assert {"requeue", "signal", "time"} <= wanted.keys(), "it is queued again, and told before its time is up"
    assert wanted["open-mode"] == "append", "the log of before stays"


def test_the_kubernetes_job_is_valid_and_runs_as_the_workers_do() -> None:
    document = yaml.safe_load(BURST.read_text())
    kubernetes_validate.validate(document, "1.30", strict=True)
    fixed = _files()["fixed-cpu/workers.yaml"][0]
    ours, theirs = document["spec"]["template"]["spec"], fixed["spec"]["template"]["spec"]
    for same in ("serviceAccountName", "securityContext", "volumes"):
        assert ours[same] == theirs[same]
    for same in ("envFrom", "env", "resources", "securityContext", "volumeMounts"):
        assert ours["containers"][0][same] == theirs["containers"][0][same]
    assert document["spec"]["template"]["metadata"]["labels"]["graspd/talks-to"] == "redis-store", "the network opens"
    assert ours["restartPolicy"] == "Never", "a pod failure policy needs it"
