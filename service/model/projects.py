"""Projects: groups of keys that share jobs, datasets, hands and objects, isolated from each other."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import Field

#: Lower case only, so that no two names differ only in case.
PATTERN: Final = r"^[a-z0-9][a-z0-9-]{0,31}$"
Project = Annotated[str, Field(pattern=rf"^$|{PATTERN}")]
#: File added to a private upload. The same mesh then has different digests in different projects, and digests reveal
#: nothing about other projects.
MARK: Final = "graspd-project.txt"


@dataclass(frozen=True)
class ProjectScope:
    """Visible resources: all, or those of one project and shared hands and objects."""

    project: str = ""
    """Preferred project, if several projects have a resource of the same name."""
    everything: bool = True

    def can_see(self, project: str) -> bool:
        return self.everything or project == self.project


#: Scope of admins, of the controller, and of all users of a service without keys.
EVERYTHING: Final = ProjectScope()


def project_mark(files: Mapping[str, bytes], project: str) -> dict[str, bytes]:
    """Return the file that marks a private upload; for a shared one, an empty file that replaces a mark."""
    return {MARK: project.encode()} if project or MARK in files else {}
