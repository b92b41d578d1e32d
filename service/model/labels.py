"""What names and addresses of things look like."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import Field, StringConstraints

#: A name a user gives: used in file names and URLs, so letters, digits, dot, dash and underscore only.
NAME: Final = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
Name = Annotated[str, Field(pattern=NAME)]
#: A name a user gives to grasps: words of such characters with one space between.
TagName = Annotated[
    str,
    StringConstraints(strip_whitespace=True, max_length=64, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*( [A-Za-z0-9._-]+)*$"),
]
#: Lower-case hexadecimal SHA-256, shortened to 32 digits (128 bits).
DIGEST: Final = r"^[0-9a-f]{32}$"
Digest = Annotated[str, Field(pattern=DIGEST)]
#: An id or nothing. Whoever writes to Redis may say anything, so what is read from there is bounded like this.
Word = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{0,64}$")]
