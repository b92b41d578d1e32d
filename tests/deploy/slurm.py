"""A cluster of one machine that runs batch scripts as Slurm does: arrays, preemption, lost nodes, time limits.

It knows the options that our scripts use and refuses all others, so that a misspelt one is found.
"""

import os
import re
import signal
import subprocess
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

#: Options of sbatch that a script may use, and what each looks like.
_OPTIONS: Final = (
    dict.fromkeys(("nodes", "ntasks"), r"1")
    | dict.fromkeys(("cpus-per-task", "gpus"), r"\d+")
    | {"requeue": r""}
    | {"job-name": r"[\w-]+", "mem": r"\d+[MG]", "time": r"(\d+-)?\d\d:\d\d:\d\d", "open-mode": r"append"}
    | {"signal": r"B:USR1@\d+", "output": r"[\w%-]+\.log", "array": r"\d+-\d+"}
)


def directives(script: Path) -> dict[str, str]:
    """Options in a batch script. Slurm reads them up to the first command; ValueError for one that is unknown."""
    found = {}
    for line in script.read_text().splitlines()[1:]:
        if line.strip() and not line.startswith("#"):
            break
        if line.startswith("#SBATCH "):
            name, _, value = line.removeprefix("#SBATCH --").partition("=")
            if name not in _OPTIONS or not re.fullmatch(_OPTIONS[name], value):
                raise ValueError(f"{script.name}: {line}")
            found[name] = value
    return found


@dataclass
class Element:
    id: int
    """Its own; that of one element is the number of its array as well."""
    name: str
    """As users write it: `array_element`, or the number of a job without an array."""
    script: Path
    environment: Mapping[str, str]
    log: Path
    restarts: int = 0
    process: subprocess.Popen[bytes] | None = None
    ended: list[int] = field(default_factory=list)
    """Exit codes of the runs that ended."""

    def start(self) -> None:
        environment = {**self.environment, "SLURM_JOB_ID": str(self.id), "SLURM_RESTART_COUNT": str(self.restarts)}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                ["bash", str(self.script)], stdout=log, stderr=log, env=environment, start_new_session=True
            )

    def signal(self, number: int, *, everybody: bool) -> None:
        assert self.process is not None
        (os.killpg if everybody else os.kill)(self.process.pid, number)

    def wait(self, seconds: float) -> int:
        assert self.process is not None
        code = self.process.wait(seconds)
        self.ended.append(code)
        return code


class FakeSlurm:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.elements: list[Element] = []
        (folder / "bin").mkdir(parents=True)
        (folder / "requeued").mkdir()
        scontrol = folder / "bin" / "scontrol"
        scontrol.write_text(f'#!/bin/sh\n[ "$1" = requeue ] && touch "{folder}/requeued/$2"\n')
        scontrol.chmod(0o755)

    def sbatch(self, script: Path, environment: Mapping[str, str], *, array: int = 0) -> list[Element]:
        options = directives(script)
        first = 1000 + len(self.elements)
        base = {
            **environment,
            "PATH": f"{self.folder / 'bin'}:{environment['PATH']}",
            "SLURM_CPUS_PER_TASK": options["cpus-per-task"],
        }
        made = []
        for number in range(array or 1):
            of_array = {"SLURM_ARRAY_JOB_ID": str(first), "SLURM_ARRAY_TASK_ID": str(number)} if array else {}
            name = f"{first}_{number}" if array else str(first)
            made.append(Element(first + number, name, script, {**base, **of_array}, self.folder / f"{name}.log"))
            made[-1].start()
        self.elements += made
        return made

    def preempt(self, element: Element, *, grace_s: float) -> None:
        """SIGTERM to all, SIGKILL after the grace time, and again from the start."""
        element.signal(signal.SIGTERM, everybody=True)
        try:
            element.wait(grace_s)
        finally:
            self._again(element)

    def lose_node(self, element: Element) -> None:
        """SIGKILL to all without a word, and again from the start."""
        element.signal(signal.SIGKILL, everybody=True)
        element.wait(60)
        self._again(element)

    def reach_time_limit(self, element: Element, *, notice_s: float) -> bool:
        """SIGUSR1 to the batch shell, SIGKILL after the notice; whether it asked to be queued again, it alone."""
        element.signal(signal.SIGUSR1, everybody=False)
        element.wait(notice_s)
        asked = {file.name for file in (self.folder / "requeued").iterdir()}
        for name in asked:
            (self.folder / "requeued" / name).unlink()
        if asked == {element.name}:
            self._again(element)
        # The number of an array means all its elements.
        return asked == {element.name}

    def logs(self) -> str:
        return "\n".join(f"--- {file.name}\n{file.read_text()[-1500:]}" for file in sorted(self.folder.glob("*.log")))

    def close(self) -> None:
        for element in self.elements:
            if element.process is not None and element.process.poll() is None:
                element.signal(signal.SIGKILL, everybody=True)
                element.process.wait()

    def _again(self, element: Element) -> None:
        assert element.process is not None
        # Whatever of the job outlived its shell goes with it.
        deadline = time.monotonic() + 60
        with suppress(ProcessLookupError):
            while time.monotonic() < deadline:
                element.signal(signal.SIGKILL, everybody=True)
                element.process.poll()
                time.sleep(0.01)
        element.restarts += 1
        element.start()
