"""A card as a page: `README.md` with the YAML head for dataset hubs, and citations as BibTeX."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, Final

from graspd.studies.cards import tables
from graspd.studies.cards.findings import findings
from graspd.studies.cards.tables import percent, size
from graspd.worker.quality import gate as gates

Row = Mapping[str, Any]
#: Size classes of dataset hubs.
_SIZES: Final = (
    (1_000, "n<1K"),
    (10_000, "1K<n<10K"),
    (100_000, "10K<n<100K"),
    (1_000_000, "100K<n<1M"),
    (10_000_000, "1M<n<10M"),
)
#: Most objects of a table that is not collapsed.
_UNFOLDED: Final = 20
_LEVELS: Final = {
    "dexgraspbench": "MuJoCo, DexGraspBench's protocol unchanged",
    "standard": "MuJoCo, DexGraspBench's protocol with early termination of pushes",
    "fast": "MuJoCo with coarse physics; level standard decides cases near a limit",
}
_NOT_MODELLED: Final = """\
- Verdicts come from simulation: pushes with the object's weight from six sides after the hand has closed. Mass and
  friction are the stated ones, by default 0.1 kg and 0.6. The verdicts are weak evidence for another mass or friction,
  for a lift, or for a real hand. No grasp was tested on a robot.
- Objects and pads are rigid. Pads that yield by 2 mm change some verdicts in either direction.
- There is no arm: its reach and its collisions with the table are not tested. "Clear of the table" refers to the hand
  alone, at contact and on the trajectory from the pregrasp.
- A scene contains one object, dropped onto a plane as its convex hull.
- Pictures have procedural materials and no textures, sensor noise, lens distortion or motion blur. The card counts
  them but does not check their content.
- ε and contact area depend mostly on the contact threshold: compare them only at equal thresholds."""
_ENTRIES: Final = {
    "fast_graspd": """@inproceedings{turpin2023fastgraspd,
  title     = {Fast-Grasp'D: Dexterous Multi-finger Grasp Generation Through Differentiable Simulation},
  author    = {Turpin, Dylan and Zhong, Tao and Zhang, Shutong and Zhu, Guanglei and Liu, Jingzhou and Singh, Ritvik and
               Heiden, Eric and Macklin, Miles and Tsogkas, Stavros and Dickinson, Sven and Garg, Animesh},
  booktitle = {IEEE International Conference on Robotics and Automation (ICRA)},
  year      = {2023}
}""",
    "graspd2022": """@inproceedings{turpin2022graspd,
  title     = {Grasp'D: Differentiable Contact-rich Grasp Synthesis for Multi-fingered Hands},
  author    = {Turpin, Dylan and Wang, Liquan and Heiden, Eric and Chen, Yun-Chun and Macklin, Miles and
               Tsogkas, Stavros and Dickinson, Sven and Garg, Animesh},
  booktitle = {European Conference on Computer Vision (ECCV)},
  year      = {2022}
}""",
    "graspit": """@article{ciocarlie2009hand,
  title   = {Hand Posture Subspaces for Dexterous Robotic Grasping},
  author  = {Ciocarlie, Matei T. and Allen, Peter K.},
  journal = {The International Journal of Robotics Research},
  volume  = {28},
  number  = {7},
  year    = {2009}
}""",
    "dfc": """@inproceedings{wang2023dexgraspnet,
  title     = {DexGraspNet: A Large-Scale Robotic Dexterous Grasp Dataset for General Objects Based on Simulation},
  author    = {Wang, Ruicheng and Zhang, Jialiang and Chen, Jiayi and Xu, Yinzhen and Li, Puhao and Liu, Tengyu and
               Wang, He},
  booktitle = {IEEE International Conference on Robotics and Automation (ICRA)},
  year      = {2023}
}""",
    "autograsp": """@article{miller2004graspit,
  title   = {GraspIt! A Versatile Simulator for Robotic Grasping},
  author  = {Miller, Andrew T. and Allen, Peter K.},
  journal = {IEEE Robotics \\& Automation Magazine},
  volume  = {11},
  number  = {4},
  year    = {2004}
}""",
}


def front_matter(card: Row) -> str:
    """Return the YAML head: every value is a JSON value, which is valid YAML."""
    made = card["composition"]
    known: dict[str, Any] = {"pretty_name": card["name"]}
    if card["licence"]:
        known["license"] = card["licence"].lower()
    kind = next((name for limit, name in _SIZES if made["valid"] < limit), "n>10M")
    tags = ["grasping", "dexterous-manipulation", "synthetic", "graspd", *(hand["name"] for hand in made["hands"])]
    known |= {"task_categories": ["robotics"], "size_categories": [kind], "annotations_creators": ["machine-generated"]}
    known |= {"tags": list(dict.fromkeys(tags))}
    lines = [f"{key}: {json.dumps(value, ensure_ascii=False)}" for key, value in known.items()]
    return "\n".join(["---", *lines, "---"])


def page(card: Row, plots: Mapping[str, str]) -> str:
    """Return the whole page; `plots` are file names and captions."""
    sections = (
        front_matter(card),
        f"# {card['name']}",
        _summary(card, plots),
        _composition(card),
        _making(card),
        _validity(card, plots),
        _quality(card, plots),
        _coverage(card, plots),
        _biases(card),
        _licence(card),
        _opening(card),
        _citing(card),
        _files(card, plots),
    )
    return "\n\n".join(section for section in sections if section) + "\n"


def _summary(card: Row, plots: Mapping[str, str]) -> str:
    made, making = card["composition"], card["making"]
    with_pictures = f", {made['pictures']:,} pictures of {made['scenes']:,} scenes" if made["pictures"] else ""
    by = " and ".join(making["methods"]) or "an unknown method"
    validated = " and ".join(making["levels"])
    lines = [
        f"{made['valid']:,} valid grasps{_places(making)} of {_count(len(made['hands']), 'robot hand')} on "
        f"{_count(len(made['objects']), 'object')}{with_pictures}. Planned by `{by}`, "
        + (f"validated by MuJoCo (`{validated}`), measured" if validated else "measured, not validated")
        + f"; made by graspd {' and '.join(making['code_versions'])}."
    ]
    if taken := card["snapshot"]:
        whole = "complete" if taken["complete"] else "**not complete**"
        lines.append(f"Snapshot `{taken['digest']}` of {taken['created'][:19]}Z, {whole}.")
    if card["source"]:
        lines.append(card["source"])
    lines.append("Every figure on this page was computed from the shards; `card.json` has all of them.")
    return "\n".join(lines) + _plot("samples.jpg", plots)


def _places(making: Row) -> str:
    beside = f" with neighbours {', '.join(making['neighbours'])}" if making.get("neighbours") else ""
    return f" in scenes ({' and '.join(making['scenes'])}{beside})" if making["scenes"] else ""


def _composition(card: Row) -> str:
    made = card["composition"]
    shards = ", ".join(
        f"{made['shards'][kind]:,} {kind} ({size(made['bytes'][kind])})"
        for kind in made["shards"]
        if made["shards"][kind]
    )
    counts = (
        f"{made['cells']:,} pairs of hand and object, {made['grasps']:,} grasps of which {made['valid']:,} are valid, "
        f"{made['scenes']:,} scenes, {made['pairs']:,} pairs of grasp and scene, {made['pictures']:,} pictures. "
        f"Shards: {shards}; {size(sum(made['bytes'].values()))} in all."
    )
    objects = tables.objects_table(card)
    if len(made["objects"]) > _UNFOLDED:
        objects = _details(f"Objects: {len(made['objects']):,}", objects)
    return f"## Contents\n\n{counts}\n\n{tables.hands_table(card)}\n\n{objects}"


def _making(card: Row) -> str:
    making = card["making"]
    knobs = ", ".join(str(found.get("name", "custom")) for found in making["fidelities"])
    rows = {
        "method, fidelity": f"{', '.join(making['methods'])}; {knobs}",
        "validation": "; ".join(_LEVELS.get(level, level) for level in making["levels"]) or "none",
        "imported from": ", ".join(making["imported_from"]),
        "friction of ε and Vol": ", ".join(f"{value:g}" for value in making["friction"]),
        "contact threshold of the figures": _millimetres(card["contact_threshold_m"]),
        "seeds": ", ".join(map(str, making["seeds"])),
        "graspd": ", ".join(making["code_versions"]),
        "revisions of the stages": ", ".join(
            f"{kind} {' and '.join(map(str, of))}" for kind, of in making["revisions"].items()
        ),
        "devices": ", ".join(making["devices"]),
        "workers": str(making["workers"] or ""),
        "shards written": f"{making['first_shard'][:19]}Z to {making['last_shard'][:19]}Z"
        if making["first_shard"]
        else "",
        "worker seconds": ", ".join(f"{kind} {value:,.0f}" for kind, value in making["seconds"].items()),
        "seconds of base shards by part": ", ".join(
            f"{name} {value:,.0f}" for name, value in making["synthesis_parts"].items()
        ),
        "per 1,000 valid grasps": _per_thousand(card),
    }
    lines = "\n".join(
        f"| {name} | {value or 'not recorded'} |" for name, value in rows.items() if value or name != "imported from"
    )
    options = ""
    if making["options"]:
        options = "\n\n" + _details("Options of the jobs", f"```json\n{json.dumps(making['options'], indent=1)}\n```")
    return f"## How it was made\n\n| | |\n| --- | --- |\n{lines}{options}"


def _per_thousand(card: Row) -> str:
    making, valid = card["making"], card["composition"]["valid"]
    if not making["seconds_per_1000_valid"]:
        return ""
    each = ", ".join(f"{kind} {1000 * value / valid:,.0f} s" for kind, value in making["seconds"].items())
    return f"{making['seconds_per_1000_valid']:,.0f} worker seconds ({each})"


def _validity(card: Row, plots: Mapping[str, str]) -> str:
    gate = (
        f"penetration at most {gates.MAX_PENETRATION_MM:g} mm, self-penetration at most "
        f"{gates.MAX_SELF_PENETRATION_MM:g} mm, at least {gates.MIN_CONTACT_LINKS} links in contact"
    )
    if card["making"]["scenes"] and card["making"]["levels"]:
        text = (
            f"Grasps were planned{_places(card['making'])}, and valid ones are lifted there. In MuJoCo the hand "
            "moves along its approach without contact, closes, lifts the object 10 cm out of the scene and "
            "holds it. "
            f"Valid grasps also pass the geometric gate: {gate}.{_hard(card)}"
        )
    elif card["making"]["levels"]:
        text = (
            f"A grasp is valid if it holds in the validator and passes the geometric gate: {gate}. "
            'Rechecked grasps were validated again under the unmodified DexGraspBench protocol. "False valid" is the '
            "share of rechecked grasps that fail there."
        )
    else:
        text = (
            f"Not validated: no grasp is valid. Grasps that pass the geometric gate ({gate}) are feasible; "
            "whether they hold is unknown."
        )
    return f"## Validity\n\n{text}\n\n{tables.validity_table(card)}{_plot('yield.png', plots)}"


def _hard(card: Row) -> str:
    found = card["validity"]["lift_hard"]
    return f" At half friction {percent(found['share'])} of them are also lifted." if found else ""


def _quality(card: Row, plots: Mapping[str, str]) -> str:
    at = _millimetres(card["contact_threshold_m"])
    text = f"Valid grasps: median (5th to 95th percentile). ε, Vol and contact area have a contact threshold of {at}."
    note = (
        "D: share of variance explained by the first principal component of position, rotation and joints; "
        f"lower is more diverse. Directions: {card['directions']['cells']} cells of equal area for the palm's approach "
        "in the object's frame."
    )
    fold = _details("Each hand on each object (medians)", f"{tables.cells_table(card)}\n\n{note}")
    return f"## Quality\n\n{text}\n\n{tables.quality_table(card)}{_plot('quality.png', plots)}\n\n{fold}"


def _coverage(card: Row, plots: Mapping[str, str]) -> str:
    shown = "".join(_plot(name, plots) for name in ("directions.png", "table.png", "joints.png", "sizes.png"))
    missing = []
    if "directions.png" not in plots:
        missing.append("approach directions of palms and use of joints (the hands' files are not available)")
    if "table.png" not in plots and not card["making"]["scenes"]:
        missing.append("clearance of the table (no scenes)")
    if "sizes.png" not in plots:
        missing.append("sizes of the objects")
    note = f"\n\nNot known: {'; '.join(missing)}." if missing else ""
    table = card["table"]
    clear = ""
    if table["grasps"]:
        clear = (
            f"\n\n{table['clear']:,} of {table['grasps']:,} valid grasps ({percent(table['of_grasps']['share'])}) are "
            f"clear of the table in at least one of their scenes, and so are {table['clear_pairs']:,} of "
            f"{table['pairs']:,} "
            "pairs."
            " A pair is a grasp in a scene."
        )
    return f"## Coverage{clear}{shown}{note}"


def _biases(card: Row) -> str:
    found = "\n".join(f"- {line}" for line in findings(card)) or "- None found."
    return (
        f"## Known biases and failures\n\nIn this dataset:\n\n{found}\n\n"
        f"In all datasets made by this method:\n\n{_NOT_MODELLED}"
    )


def _licence(card: Row) -> str:
    own = (
        f"The grasps, scenes and pictures: **{card['licence']}**."
        if card["licence"]
        else ("**No licence was stated for this dataset.** The option `--licence` adds one.")
    )
    return (
        f"## Licence\n\n{own} Meshes of hands and objects are not in the shards. Pictures and grasps are derived "
        "from them, so the licences in the tables above also apply."
    )


def _opening(card: Row) -> str:
    example = f"""```python
from graspd.service.readers import Grasps, open_shards

grasps = Grasps(open_shards("{card["name"]}").only(hands=["{card["composition"]["hands"][0]["name"]}"]))
arrays = grasps.arrays("grasp/hand_pose", "grasp/joint_positions", "quality/epsilon")
print(len(grasps), arrays["grasp/hand_pose"].shape, grasps.joint_names("{card["composition"]["hands"][0]["name"]}"))
```"""
    return (
        f"## How to open it\n\n`{card['name']}` is a folder of shards, written by `graspd datasets export`. With "
        f"graspd:\n\n{example}\n\nOr with any HDF5 tool: each dataset has `units`, `frame` and `description`. A pose "
        "is x y z [m] and a unit quaternion w x y z of the hand's root link in the object's frame."
    )


def _citing(card: Row) -> str:
    making = card["making"]
    year = (making["last_shard"] or card["card_made"])[:4]
    snapshot = card["snapshot"]["digest"] if card["snapshot"] else ""
    entries = citations(making["methods"], card["name"], " and ".join(making["code_versions"]), year, snapshot)
    return (
        "## How to cite it\n\nCite the method's paper, the dataset, and the sources of the hands and objects "
        "that you use.\n\n"
        f"```bibtex\n{entries}\n```"
    )


def _files(card: Row, plots: Mapping[str, str]) -> str:
    names = ", ".join(f"[{name}]({name})" for name in plots)
    return (
        "## Files\n\n[card.json](card.json): all figures. [checksums.sha256](checksums.sha256): checksums of all "
        "shards; "
        f"`sha256sum -c` checks them in the folder of the shards. Plots: {names or 'none'}."
    )


def _plot(name: str, plots: Mapping[str, str]) -> str:
    return f"\n\n![{plots[name]}]({name})" if name in plots else ""


def _details(title: str, text: str) -> str:
    return f"<details><summary>{title}</summary>\n\n{text}\n\n</details>"


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"


def _millimetres(value: float | None) -> str:
    return "not recorded" if value is None else f"{1e3 * value:g} mm"


def citations(methods: Iterable[str], name: str, version: str, year: str, snapshot: str) -> str:
    """Return BibTeX of the methods' papers and of the dataset itself; `snapshot` may be empty."""
    note = f",\n  note   = {{snapshot {snapshot}}}" if snapshot else ""
    key = "".join(letter for letter in name if letter.isalnum()) or "dataset"
    own = f"""@misc{{{key}{year},
  title  = {{{name}: grasps made by graspd {version}}},
  year   = {{{year}}}{note}
}}"""
    return "\n\n".join([*(_ENTRIES[method] for method in methods if method in _ENTRIES), own])
