"""Cluster files read by the tools that they are for: `make clusters` runs this in an environment that has them.

SkyPilot and Ray bring versions of libraries that need not fit graspd's, so their environment is their own, and nothing
of graspd is imported here.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[2]
CLUSTERS = REPOSITORY / "docker" / "clusters"


def check_skypilot() -> str:
    """The schema, and the parser that `sky jobs launch` uses."""
    import sky
    import yaml
    from jsonschema import validate
    from sky.utils import schemas

    document = yaml.safe_load((CLUSTERS / "skypilot.yaml").read_text())
    validate(document, schemas.get_task_schema())
    secrets = [(name, "given") for name in document["secrets"]]
    task = sky.Task.from_yaml_config(document, secrets_overrides=secrets)
    assert all(one.use_spot for one in task.resources), "spot GPUs were asked for"
    return f"SkyPilot {sky.__version__}: {len(task.resources)} kinds of GPU, on spot machines"


def check_apptainer() -> str:
    """The definition, as Singularity's own Python package reads it."""
    import spython
    from spython.main.parse.parsers import get_parser

    recipe = get_parser("singularity")(str(REPOSITORY / "docker" / "slurm" / "graspd.def")).recipe["spython-base"]
    assert recipe.fromHeader.startswith("python:3.11"), recipe.fromHeader
    assert 'exec graspd "$@"' in recipe.cmd
    assert any("pip install" in line for line in recipe.install)
    return f"spython {spython.__version__}: from {recipe.fromHeader}, {len(recipe.install)} lines of %post"


def check_ray() -> str:
    """Two workers on a Ray of this machine, with a command that writes down how it was called."""
    import ray

    with tempfile.TemporaryDirectory() as folder:
        called, stub = Path(folder) / "called", Path(folder) / "graspd"
        stub.write_text(f'#!/bin/sh\necho "$GRASPD_REDIS_URL $@" >> {called}\n')
        stub.chmod(0o755)
        command = [sys.executable, str(CLUSTERS / "ray_workers.py"), "--workers", "2", "--cpus", "1"]
        environment = {"GRASPD_REDIS_URL": "redis://there", "PYTHONPATH": str(REPOSITORY), "PATH": "/usr/bin:/bin"}
        subprocess.run(
            [*command, "--graspd", str(stub)], check=True, capture_output=True, timeout=180,
            env={**environment, "HOME": folder, "RAY_AUTH_MODE": "disabled", "RAY_USAGE_STATS_ENABLED": "0"},
        )  # fmt: skip
        lines = called.read_text().splitlines()
    assert lines == ["redis://there worker --burst --idle 60 --threads 1"] * 2, lines
    return f"Ray {ray.__version__}: two workers ran and ended"


if __name__ == "__main__":
    for check in (check_skypilot, check_apptainer, check_ray):
        sys.stdout.write(f"{check()}\n")
        sys.stdout.flush()
