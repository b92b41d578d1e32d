"""Docker and its compose as a test uses them: whether they can be had here, and one project that is gone afterwards."""

import json
import re
import secrets
import subprocess
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.conftest import REPOSITORY
from tests.deploy import composition
from tests.shell import completed

DOCKERFILE = REPOSITORY / "docker" / "Dockerfile"
_BUILD_S = 3600.0


class NoEngine(Exception):
    """What the test needs is not here; the message says what."""


def docker(*arguments: str, timeout: float = 120.0, check: bool = True) -> str:
    done = completed(["docker", *arguments], timeout=timeout)
    assert not check or done.returncode == 0, f"docker {' '.join(arguments)}: {(done.stdout + done.stderr)[-3000:]}"
    return done.stdout


def base_images() -> set[str]:
    stages = re.findall(r"^FROM (\S+) AS (\S+)$", DOCKERFILE.read_text(), re.MULTILINE)
    ours = {name for _, name in stages}
    services = composition.SERVICES.values()
    return {image for image, _ in stages} - ours | {one["image"] for one in services if "build" not in one}


def look_for_engine() -> None:
    for what, command in {
        "container engine": ["docker", "info"],
        "docker compose": ["docker", "compose", "version"],
        "docker buildx": ["docker", "buildx", "version"],
    }.items():
        try:
            done = completed(command, timeout=60)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise NoEngine(f"no {what} here ({error})") from None
        if done.returncode:
            raise NoEngine(f"no {what} here ({_why(done)})")
    for image in sorted(base_images()):
        if completed(["docker", "image", "inspect", image]).returncode == 0:
            continue
        try:
            done = completed(["docker", "pull", "-q", image], timeout=900)
        except subprocess.TimeoutExpired:
            raise NoEngine(f"the base image {image} did not come within 15 minutes") from None
        if done.returncode:
            raise NoEngine(f"the base image {image} is neither here nor to be had ({_why(done)}); see install.md")


def _why(done: subprocess.CompletedProcess[str]) -> str:
    return (done.stderr.strip().splitlines() or ["no reason given"])[-1]


@dataclass
class Project:
    folder: Path
    variables: Mapping[str, str]

    def __post_init__(self) -> None:
        self.name = f"graspd-test-{secrets.token_hex(4)}"
        (self.folder / ".env").write_text("".join(f"{name}={value}\n" for name, value in self.variables.items()))

    def compose(self, *arguments: str, timeout: float = 600.0, check: bool = True) -> str:
        place = ("--project-directory", str(REPOSITORY), "--env-file", str(self.folder / ".env"))
        return docker("compose", "-p", self.name, *place, *arguments, timeout=timeout, check=check)

    def build(self) -> None:
        self.compose("build", "-q", timeout=_BUILD_S)

    def containers(self, service: str) -> list[str]:
        return self.compose("ps", "-q", service).split()

    def looked_at(self, container: str) -> dict[str, Any]:
        (found,) = json.loads(docker("inspect", container))
        return dict(found)

    def logs(self) -> str:
        return self.compose("logs", "--no-color", "--tail", "40", check=False)[-12_000:]

    def close(self) -> None:
        self.compose("down", "-v", "--remove-orphans", "-t", "20", check=False)
        for image in self.images():
            docker("rmi", "-f", image, check=False)

    def images(self) -> Iterator[str]:
        for service in json.loads(self.compose("config", "--format", "json"))["services"].values():
            if "build" in service:
                yield service["image"]
