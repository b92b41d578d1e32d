"""Files for clusters: in step with commands and settings; the batch scripts run in tests/system/test_slurm.py."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

import graspd.cli
from graspd.service.settings import Settings
from tests.conftest import REPOSITORY
from tests.deploy.slurm import directives

BURST = REPOSITORY / "docker" / "kubernetes" / "burst.yaml"
SLURM = REPOSITORY / "docker" / "slurm"
PAGE = (REPOSITORY / "docs" / "how-to" / "clusters.md").read_text()
SETTINGS = {f"GRASPD_{name.upper()}" for name in Settings.model_fields}
FILES = [BURST, *sorted(SLURM.iterdir())]


def options_of(command: str) -> set[str]:
    module = next(module for name, module, *_ in graspd.cli.COMMANDS if name == command)
    loaded: Any = graspd.cli.load(module, command)
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


def test_the_fake_refuses_an_option_that_slurm_does_not_know(tmp_path: Path) -> None:
    script = tmp_path / "x.sbatch"
    script.write_text("#!/bin/bash\n#SBATCH --reqeue\n")
    with pytest.raises(ValueError, match="reqeue"):
        directives(script)


def test_the_kubernetes_job_is_valid_and_runs_as_the_workers_do() -> None:
    document = yaml.safe_load(BURST.read_text())
    kubernetes_validate.validate(document, "1.30", strict=True)
    manifests = (REPOSITORY / "docker" / "kubernetes" / "fixed-cpu" / "workers.yaml").read_text()
    fixed = next(yaml.safe_load_all(manifests))
    ours, theirs = document["spec"]["template"]["spec"], fixed["spec"]["template"]["spec"]
    for same in ("serviceAccountName", "securityContext", "volumes"):
        assert ours[same] == theirs[same]
    for same in ("envFrom", "env", "resources", "securityContext", "volumeMounts"):
        assert ours["containers"][0][same] == theirs["containers"][0][same]
    assert document["spec"]["template"]["metadata"]["labels"]["graspd/talks-to"] == "redis-store", "the network opens"
    assert ours["restartPolicy"] == "Never", "a pod failure policy needs it"


def test_commands_of_the_page_are_shell() -> None:
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
    assert len(blocks) >= 4
    for block in blocks:
        subprocess.run(["bash", "-n", "-c", block], check=True)
        for line in block.splitlines():
            words = shlex.split(line.replace("\\", ""), comments=True)
            if words[:1] == ["sbatch"]:
                assert (REPOSITORY / words[-1]).is_file(), line
