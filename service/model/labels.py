"""What names and addresses of things look like."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import Field

#: A name a user gives: used in file names and URLs, so letters, digits, dot, dash and underscore only.
NAME: Final = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"
Name = Annotated[str, Field(pattern=NAME)]
#: Lower-case hexadecimal SHA-256, shortened to 32 digits (128 bits).
DIGEST: Final = r"^[0-9a-f]{32}$"
Digest = Annotated[str, Field(pattern=DIGEST)]
#: An id or nothing. Whoever writes to Redis may say anything, so what is read from there is bounded like this.
Word = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{0,64}$")]
