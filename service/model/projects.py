"""Projects: groups of keys that share jobs, datasets, hands and objects, and see nothing of each other's.

Where nobody names a project, all belongs to the one without a name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final

from pydantic import Field

#: Lower case, so that no two names differ where a person does not look.
PATTERN: Final = r"^[a-z0-9][a-z0-9-]{0,31}$"
#: What a key, a job or a dataset belongs to; empty: the project without a name.
Project = Annotated[str, Field(pattern=rf"^$|{PATTERN}")]
#: File that an upload has besides its own where only its project may see it. So the same mesh of two projects is two
#: objects, whose digests say nothing of each other.
MARK: Final = "graspd-project.txt"


@dataclass(frozen=True)
class ProjectScope:
    """What somebody may see: the things of a project, and the hands and objects that are shared; or everything."""

    project: str = ""
    """Whose names come first, where two projects use the same one."""
    everything: bool = True

    def sees(self, project: str) -> bool:
        """Whether the jobs and datasets of a project are in scope."""
        return self.everything or project == self.project


#: The scope of an admin, of the controller, and of everybody while the service is open.
EVERYTHING: Final = ProjectScope()


def marks_of(files: Mapping[str, bytes], project: str) -> dict[str, bytes]:
    """The file that marks an upload as one project's own; for what is shared an empty one over a mark that it brings.

    Args:
        project: empty for what is shared, and for the project without a name.
    """
    return {MARK: project.encode()} if project or MARK in files else {}
