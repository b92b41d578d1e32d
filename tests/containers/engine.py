"""Docker and its compose as a test uses them: whether they can be had here, and one project that is gone afterwards."""

from __future__ import annotations

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
    """What a command of Docker prints.

    Raises:
        AssertionError: it failed; with its last words.
    """
    done = completed(["docker", *arguments], timeout=timeout)
    assert not check or done.returncode == 0, f"docker {' '.join(arguments)}: {(done.stdout + done.stderr)[-3000:]}"
    return done.stdout


def base_images() -> set[str]:
    """Images of others that the Dockerfile and the compose file stand on."""
    stages = re.findall(r"^FROM (\S+) AS (\S+)$", DOCKERFILE.read_text(), re.MULTILINE)
    ours = {name for _, name in stages}
    services = composition.SERVICES.values()
    return {image for image, _ in stages} - ours | {one["image"] for one in services if "build" not in one}


def look_for_engine() -> None:
    """Return where an engine answers, has compose and buildx, and has or gets the base images.

    Raises:
        NoEngine: it does not.
    """
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
            raise NoEngine(f"no {what} here ({(done.stderr.strip().splitlines() or ['no reason given'])[-1]})")
    for image in sorted(base_images()):
        if subprocess.run(["docker", "image", "inspect", image], capture_output=True, check=False).returncode == 0:
            continue
        try:
            done = completed(["docker", "pull", "-q", image], timeout=900)
        except subprocess.TimeoutExpired:
            raise NoEngine(f"the base image {image} did not come within 15 minutes") from None
        if done.returncode:
            why = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            raise NoEngine(f"the base image {image} is neither here nor to be had ({why}); see docs/how-to/install.md")


@dataclass
class Project:
    """The compose file as a project of its own, with images, volumes and a network of its own."""

    folder: Path
    variables: Mapping[str, str]

    def __post_init__(self) -> None:
        self.name = f"graspd-test-{secrets.token_hex(4)}"
        (self.folder / ".env").write_text("".join(f"{name}={value}\n" for name, value in self.variables.items()))

    def compose(self, *arguments: str, timeout: float = 600.0, check: bool = True) -> str:
        """What `docker compose` prints, with the `.env` of this project."""
        place = ("--project-directory", str(REPOSITORY), "--env-file", str(self.folder / ".env"))
        return docker("compose", "-p", self.name, *place, *arguments, timeout=timeout, check=check)

    def build(self) -> None:
        """All images that the profiles name."""
        self.compose("build", "-q", timeout=_BUILD_S)

    def containers(self, service: str) -> list[str]:
        """Whole ids of the running containers of a service."""
        return self.compose("ps", "-q", service).split()

    def looked_at(self, container: str) -> dict[str, Any]:
        """What the engine knows of a container."""
        (found,) = json.loads(docker("inspect", container))
        return dict(found)

    def logs(self) -> str:
        """The last lines of every container."""
        return self.compose("logs", "--no-color", "--tail", "40", check=False)[-12_000:]

    def close(self) -> None:
        """Containers, network, volumes and images of this project."""
        self.compose("down", "-v", "--remove-orphans", "-t", "20", check=False)
        for image in self.images():
            docker("rmi", "-f", image, check=False)

    def images(self) -> Iterator[str]:
        """Names of the images that this project builds."""
        for service in json.loads(self.compose("config", "--format", "json"))["services"].values():
            if "build" in service:
                yield service["image"]
