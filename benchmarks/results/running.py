"""Runs studies one after another; skips studies with current results."""

from __future__ import annotations

import importlib.util
import os
import platform
import re
import resource
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

from PIL import Image, ImageChops, ImageStat

from benchmarks.results.manifest import REPOSITORY, digests, load, revision_of_today, save, staleness, write
from benchmarks.results.studies import BROWSER, ENGINES, GPU, PREFILTER, SERVICE, TORCH, Study, files_of, is_raw
from graspd.service.model.cores import available_cores
from graspd.service.model.version import STAGE_REVISIONS
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.worker.rendering.sheets import png_bytes

#: Mean difference of a channel, of 255, above which a palette shows steps in gradients, as in depth images.
STEPS: Final = 0.45
_PACKAGES: Final = ("graspd", "numpy", "warp-lang", "mujoco", "newton")
_TEXTS: Final = {".json", ".md", ".csv", ".svg"}
_LINK: Final = re.compile(r"\[([^\]]+)\]\(([^()\s#:]+)\)")
_PLACE: Final = re.compile(r"\b(DATA|SOURCES|BEFORE|WORK|OUT)\b")
_PROGRAMS: Final = {"graspd": (sys.executable, "-m", "graspd"), "python": (sys.executable,)}


@dataclass
class Runner:
    """Runs studies; `out` is the folder of the docs, `places` has the folders DATA, SOURCES and BEFORE."""

    out: Path
    work: Path
    quick: bool = False
    again: bool = False
    one_revision: bool = False
    places: dict[str, Path] = field(default_factory=dict)

    def __post_init__(self) -> None:
        name = "-".join(f"{stage}-{number}" for stage, number in STAGE_REVISIONS.items())
        self.work = self.work.resolve() / ("quick" if self.quick else "full") / name
        self.out, self.revision = self.out.resolve(), revision_of_today()
        self.records = load(self.out)

    def lines(self, study: Study) -> tuple[str, ...]:
        return study.quick if self.quick else study.run

    def missing(self, study: Study) -> str:
        """Return why a study cannot run here; empty if it can."""
        if not study.run:
            return "a page written by hand"
        if not self.lines(study):
            return "has no quick run"
        words = " ".join(self.lines(study))
        wants = [name for name in study.wants() if name in words or name not in {"DATA", "SOURCES", "BEFORE"}]
        gone = [name for name in wants if not self._has(name)]
        return f"needs {', '.join(gone)}" if gone else ""

    def holds(self, study: Study) -> bool:
        """Return whether files are current: recorded for this study, its commands and the current revisions."""
        record = self.records.get(study.name)
        return (
            record is not None
            and record["told_by"] == "run"
            and record["command"] == self._told(study)
            and not staleness(study, record)
            and (not self.one_revision or record["revision"] == self.revision)
            and record["files"] == digests(study, self.out)
        )

    def run(self, study: Study) -> str:
        """Run one study and record it; return the outcome."""
        if reason := self.missing(study):
            return f"left out: {reason}"
        if self.holds(study) and not self.again:
            return "holds"
        began, spent = time.time(), _spent()
        if failed := self._commands(study):
            return f"FAILED: {failed}"
        files = digests(study, self.out)
        if not files:
            return "FAILED: wrote no file"
        older = [path for path in files if (self.out / path).stat().st_mtime < began]
        for file in files_of(study, self.out):
            self._without_places(file)
            slim(file)
        self.records = load(self.out) | {
            study.name: {
                "told_by": "run",
                "command": self._told(study),
                "revision": self.revision,
                "stage_revisions": dict(STAGE_REVISIONS),
                "seeds": list(study.seeds) or None,
                "machine": machine(),
                "versions": versions(),
                "date": datetime.now(UTC).date().isoformat(),
                "seconds": round(time.time() - began, 1),
                "cpu_seconds": round(_spent() - spent, 1),
                **({"older_files": older} if older else {}),
                "files": digests(study, self.out),
            }
        }
        save(self.out, self.records)
        return f"made in {time.time() - began:.0f} s"

    def _commands(self, study: Study) -> str:
        """Run the commands of a study; return the failure, if any."""
        log = self.work / "logs" / f"{study.name}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        for glob in (*study.files, study.prints):
            (self.out / glob).parent.mkdir(parents=True, exist_ok=True)
        printed = [f"# {study.about[0].upper()}{study.about[1:]}\n"]
        with log.open("wb") as errors, self._service(study) as environment:
            for line in self.lines(study):
                done = subprocess.run(
                    self._words(line),
                    cwd=REPOSITORY,
                    env=environment,
                    stdout=subprocess.PIPE,
                    stderr=errors,
                    check=False,
                )
                errors.write(done.stdout)
                if done.returncode:
                    return f"`{line}` ended with {done.returncode}; see {log}"
                printed.append(f"`{line.replace('OUT/', 'docs/')}`\n\n{done.stdout.decode().strip()}\n")
        if study.prints:
            write(self.out / study.prints, "\n".join(printed))
        return ""

    def _words(self, line: str) -> list[str]:
        places = {**self.places, "WORK": self.work, "OUT": self.out}
        program, *rest = shlex.split(line)
        rest = [_PLACE.sub(lambda found: str(places[found[0]]), word) for word in rest]
        return [*_PROGRAMS.get(program, (program,)), *rest]

    @contextmanager
    def _service(self, study: Study) -> Iterator[Mapping[str, str]]:
        """Yield the environment of the commands; start a service if the study needs one."""
        environment = {name: value for name, value in os.environ.items() if not name.startswith("GRASPD_")}
        environment["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{environment.get('PATH', '')}"
        if SERVICE not in study.needs:
            yield environment
            return
        settings = Settings(data_dir=self.work / "services" / study.name, port=0)
        with Supervisor(settings, workers=available_cores()) as supervisor:
            supervisor.wait_ready()
            yield environment | {"GRASPD_API_URL": supervisor.api_url, "GRASPD_DATA_DIR": str(settings.data_dir)}

    def _has(self, name: str) -> bool:
        checks = {
            SERVICE: lambda: True,
            BROWSER: lambda: bool(shutil.which("chromium")) and importlib.util.find_spec("playwright") is not None,
            PREFILTER: lambda: importlib.util.find_spec("mujoco_warp") is not None,
            ENGINES: lambda: all(importlib.util.find_spec(name) is not None for name in ("sapien", "pydrake")),
            TORCH: lambda: importlib.util.find_spec("torch") is not None,
            GPU: lambda: bool(shutil.which("nvidia-smi")) and not self.quick,
        }
        return checks[name]() if name in checks else name in self.places

    def _told(self, study: Study) -> list[str]:
        return [line.replace("OUT/", "docs/") for line in self.lines(study)]

    def _without_places(self, file: Path) -> None:
        """Replace folders of this machine by their general names in text files."""
        if file.suffix in _TEXTS:
            text = before = file.read_text()
            places = {self.out: "docs", self.work: "WORK", **{path: name for name, path in self.places.items()}}
            for path, name in sorted(places.items(), key=lambda item: -len(str(item[0]))):
                text = text.replace(str(path), name)
            if file.suffix == ".md":
                text = _LINK.sub(self._without_raw(file), text)
            if text != before:
                write(file, text)

    def _without_raw(self, page: Path) -> Callable[[re.Match[str]], str]:
        """Return a function that replaces links to raw results by their text: raw results are not in git."""

        def replaced(link: re.Match[str]) -> str:
            target = (page.parent / link[2]).resolve()
            raw = target.is_relative_to(self.out) and is_raw(str(target.relative_to(self.out)))
            return f"`{link[1]}`" if raw else link[0]

        return replaced


def slim(file: Path) -> None:
    """Give a PNG a palette of 256 colours if this saves bytes (about two thirds) and shows no steps."""
    if file.suffix != ".png":
        return
    with Image.open(file) as picture:
        if picture.mode == "P":
            return
        full = picture.convert("RGB")
    few = full.quantize(256, kmeans=1)
    lost = max(ImageStat.Stat(ImageChops.difference(full, few.convert("RGB"))).mean)
    if lost <= STEPS and len(smaller := png_bytes(few)) < file.stat().st_size:
        file.write_bytes(smaller)


def machine() -> str:
    names = re.findall(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text()) if sys.platform == "linux" else []
    return f"{names[0] if names else platform.machine()}, {available_cores()} cores"


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that may affect results."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _spent() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
