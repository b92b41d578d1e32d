"""XML of robots and objects from untrusted sources."""

import re
from typing import Final
from xml.etree.ElementTree import Element, ParseError

from defusedxml import ElementTree as SafeTree
from defusedxml.common import DefusedXmlException

from graspd.service.model.errors import HandError, LimitError
from graspd.service.store.hand_files import decode_text

#: Prefix of a tag or attribute; the first tag of a text.
_PREFIX: Final = re.compile(r"[<\s/]([A-Za-z_][\w.-]{0,40}):[A-Za-z_]")
_FIRST: Final = re.compile(r"<[A-Za-z_][\w:.-]*")
_MAX_PREFIXES: Final = 100


def parse_xml(data: bytes, name: str, what: str = "", root: str = "", *, limit_bytes: int) -> Element:
    """Return the root element without its namespace.
    Raises HandError: empty, not XML, or another root than `root` (`what` in the message). LimitError: larger."""
    if len(data) > limit_bytes:
        raise LimitError(f"{name}: {len(data)} bytes of XML; at most {limit_bytes} are taken")
    text = decode_text(data)
    if not text:
        raise HandError(f"{name} is empty; export it again")
    try:
        try:
            tree: Element = SafeTree.fromstring(text)
        except ParseError as error:
            # Undeclared prefixes of foreign elements (`drake:...`) are declared here.
            first = _FIRST.search(text)
            if "unbound prefix" not in str(error) or first is None:
                raise
            prefixes = sorted(set(_PREFIX.findall(text)) - {"xml", "xmlns"})
            declared = "".join(f' xmlns:{prefix}="urn:{prefix}"' for prefix in prefixes[:_MAX_PREFIXES])
            tree = SafeTree.fromstring(text[: first.end()] + declared + text[first.end() :])
    except DefusedXmlException:
        raise HandError(f"{name}: XML entities are refused; write the text out") from None
    except (ParseError, ValueError, LookupError) as error:
        raise HandError(f"{name}: not well-formed XML ({error}); export it again") from None
    space, _, local = tree.tag.rpartition("}")
    if root and local != root:
        raise HandError(f"{name}: the XML root is <{local[:40]}>, but {what} begins with <{root}>")
    if space:
        for element in tree.iter():
            element.tag = element.tag.removeprefix(space + "}")
    return tree
