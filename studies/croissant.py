"""Croissant 1.1 file of a published dataset (MLCommons): its files with checksums, and the columns of its tables."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from graspd.exchange import huggingface
from graspd.service import parquet

Row = dict[str, Any]
_TERMS: Final = (
    *("arrayShape", "citeAs", "column", "containedIn", "equivalentProperty", "extract", "field", "fileProperty"),
    *("fileObject", "fileSet", "format", "includes", "isArray", "isLiveDataset", "jsonPath", "key", "md5"),
    *("parentField", "path", "recordSet", "references", "regex", "repeated", "replace", "samplingRate"),
    *("separator", "source", "subField", "transform"),
)
_CONTEXT: Final = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    **{term: f"cr:{term}" for term in _TERMS},
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "description": {"@container": "@language"},
    "name": {"@container": "@language"},
}
_FORMATS: Final = {".parquet": "application/x-parquet", ".tar": "application/x-tar"}
_TABLES: Final = {
    "grasps": (huggingface.GRASPS, "One grasp per row. Poses: position [m] and quaternion w x y z of the hand's root "
    "link in the object's frame; joints [rad or m] in the order of joint_names."),
    "pictures": (huggingface.PICTURES, "One picture per row, with the valid grasps of its scene in the camera's frame; "
    "depth in steps of 0.1 mm, 0: no surface."),
}  # fmt: skip


def croissant(card: Row, folder: Path, sums: Mapping[Path, str]) -> Row:
    """Return the file's content from `card.json` and the SHA-256 of all data files below `folder`."""
    files = [
        {
            "@type": "cr:FileObject",
            "@id": str(file.relative_to(folder)),
            "name": str(file.relative_to(folder)),
            "contentUrl": str(file.relative_to(folder)),
            "contentSize": f"{file.stat().st_size} B",
            "encodingFormat": _FORMATS[file.suffix],
            "sha256": digest,
        }
        for file, digest in sums.items()
    ]
    tables = [table for table in _TABLES if any(file.parent.name == table for file in sums)]
    sets = [
        {
            "@type": "cr:FileSet",
            "@id": f"{table}-files",
            "name": f"{table}-files",
            "encodingFormat": _FORMATS[".parquet"],
            "includes": f"{table}/*.parquet",
        }
        for table in tables
    ]
    made = card["composition"]
    found: Row = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.1",
        "name": card["name"],
        "description": f"{made['valid']} valid grasps of {len(made['hands'])} robot hands on {len(made['objects'])} "
        f"objects, with {made['pictures']} pictures, made by graspd.",
        "version": "1.0.0",
        "datePublished": card["card_made"],
        "citeAs": f"{card['name']}: grasps made by graspd {card['graspd']}, {card['card_made'][:4]}",
        "keywords": ["grasping", "robotics", "synthetic"],
        "distribution": [*files, *sets],
        "recordSet": [_record_set(table) for table in tables],
    }
    return found | {key: card[of] for key, of in (("license", "licence"), ("creditText", "source")) if card[of]}


def _record_set(table: str) -> Row:
    columns, description = _TABLES[table]
    fields = [_field(table, name, word) for name, word in columns.items()]
    return {"@type": "cr:RecordSet", "@id": table, "name": table, "description": description, "field": fields}


def _field(table: str, name: str, word: str) -> Row:
    kind, lengths = word.split("[")[0], re.findall(r"\[(\d*)\]", word)
    source: Row = {"fileSet": {"@id": f"{table}-files"}, "extract": {"column": name}}
    if kind == parquet.IMAGE:
        source["transform"] = {"jsonPath": "bytes"}
    types = {"text": "sc:Text", parquet.IMAGE: "sc:ImageObject"}
    said: Row = {"@type": "cr:Field", "@id": f"{table}/{name}", "name": name, "source": source}
    said["dataType"] = types.get(kind, f"cr:{kind.capitalize()}")
    if lengths:
        # The type's last suffix is the outer list.
        said |= {"isArray": True, "arrayShape": ",".join(length or "-1" for length in reversed(lengths))}
    return said
