"""Projects: groups of keys that share jobs, datasets, hands and objects, isolated from each other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import Field

#: Lower case, so that no two names differ only in case.
PATTERN: Final = r"^[a-z0-9][a-z0-9-]{0,31}$"
#: Project of a key, job or dataset; empty: the unnamed project.
Project = Annotated[str, Field(pattern=rf"^$|{PATTERN}")]
#: Extra file of an upload that only its project may see. It makes the same mesh in two projects two objects, so digests
#: reveal nothing about other projects.
MARK: Final = "graspd-project.txt"


@dataclass(frozen=True)
class ProjectScope:
    """Visibility: the things of one project and shared hands and objects, or everything."""

    project: str = ""
    """Project whose names take precedence if two projects use the same one."""
    everything: bool = True

    def sees(self, project: str) -> bool:
        return self.everything or project == self.project


#: Scope of admins, of the controller, and of all users of a service without keys.
EVERYTHING: Final = ProjectScope()


def marks_of(files: Mapping[str, bytes], project: str) -> dict[str, bytes]:
    """Return the mark of a private upload; of a shared one, an empty file over any existing mark."""
    return {MARK: project.encode()} if project or MARK in files else {}
