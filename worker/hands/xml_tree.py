"""The tree of an XML text that a stranger wrote, whatever its encoding; entities are refused."""

from __future__ import annotations

import re
from typing import Final
from xml.etree.ElementTree import Element, ParseError

from defusedxml import ElementTree as SafeTree
from defusedxml.common import DefusedXmlException

from service.model.errors import HandError, LimitError
from service.store.hand_files import text_of

_PREFIX: Final = re.compile(r"[<\s/]([A-Za-z_][\w.-]{0,40}):[A-Za-z_]")
_FIRST: Final = re.compile(r"<[A-Za-z_][\w:.-]*")
_MAX_PREFIXES: Final = 100


def parse_xml(data: bytes, name: str, what: str = "", root: str = "", *, limit_bytes: int) -> Element:
    """The root element, its namespace taken off.

    Args:
        data: the file.
        name: what it is called, for messages.
        what: the kind of file, with its article.
        root: name of its root element; empty: any.
        limit_bytes: its largest size.

    Raises:
        HandError: it is empty, no XML, or has another root element.
        LimitError: larger than the limit.
    """
    if len(data) > limit_bytes:
        raise LimitError(f"{name}: {len(data)} bytes of XML; at most {limit_bytes} are taken")
    text = text_of(data)
    if not text:
        raise HandError(f"{name} is empty; export it again")
    try:
        tree = _with_prefixes(text)
    except DefusedXmlException:
        raise HandError(f"{name}: XML entities are refused; write the text out") from None
    except (ParseError, ValueError, LookupError) as error:
        raise HandError(f"{name}: not well-formed XML ({error}); export it again") from None
    space, _, local = tree.tag.rpartition("}")
    if root and local != root:
        raise HandError(f"{name}: the XML root is <{local[:40]}>, {what} begins with <{root}>")
    if space:
        for element in tree.iter():
            element.tag = element.tag.removeprefix(space + "}")
    return tree


def _with_prefixes(text: str) -> Element:
    """The tree of an XML text; prefixes of foreign elements (`drake:...`) that nobody declared are declared here."""
    try:
        tree: Element = SafeTree.fromstring(text)
    except ParseError as error:
        first = _FIRST.search(text)
        if "unbound prefix" not in str(error) or first is None:
            raise
        prefixes = sorted(set(_PREFIX.findall(text)) - {"xml", "xmlns"})
        declared = "".join(f' xmlns:{prefix}="urn:{prefix}"' for prefix in prefixes[:_MAX_PREFIXES])
        tree = SafeTree.fromstring(text[: first.end()] + declared + text[first.end() :])
    return tree
