"""From names on the command line to what the chart runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Final

from service.model.errors import InputError
from service.model.fidelity import FIDELITIES
from worker.planners import method, planner
from worker.run import Run
from worker.studies.chart.trials import Setting

#: Label of methods that know no fidelities: they run as their source has them.
LABEL: Final = "as published"

_VARIANT: Final = re.compile(r"([^:@]+)(?::([\w.]+=[\w.]+(?:\+[\w.]+=[\w.]+)*))?(?:@([1-9]\d{0,3}))?")


def settings_of(
    methods: Sequence[str],
    fidelities: Sequence[str],
    *,
    batches: Sequence[int],
    peer_batch: int,
    options: Sequence[str],
    quick: bool,
    run: Run,
) -> list[Setting]:
    """A setting for every method, fidelity and batch; methods without fidelities have one each.

    Those with a budget of steps take seconds a grasp and get `peer_batch` grasps per call, the others the first batch.

    Raises:
        InputError: unknown method, or an option that is not of one of them.
    """
    variants = [_variant(text) for text in methods]
    given = _options_of(options, [name for name, _, _ in variants])
    found: list[Setting] = []
    for name, changes, size_given in variants:
        known = method(name)
        own = {**(known.quick if quick else {}), **given.get(name, {}), **changes}
        planner(name, own)
        common: dict[str, Any] = {"options": own, "warm": known.quick, "run": run}
        if known.has_fidelities:
            found += [Setting(name, f, FIDELITIES[f], batch=b, **common) for f in fidelities for b in batches]
        else:
            size = peer_batch if "steps" in known.options.model_fields else batches[0]
            label = " ".join(f"{key}={value}" for key, value in changes.items()) or LABEL
            found.append(Setting(name, label, FIDELITIES["standard"], batch=size_given or size, **common))
    return found


def _variant(text: str) -> tuple[str, dict[str, str], int | None]:
    """`graspit:keep=20@40` as name, options and grasps per call; a plain name has neither of the last two."""
    found = _VARIANT.fullmatch(text)
    if found is None:
        raise InputError(f"{text!r} is no method; write NAME, NAME:OPTION=VALUE or NAME:OPTION=VALUE@GRASPS_PER_CALL")
    name, options, size = found.groups()
    changes = dict(part.split("=", 1) for part in options.split("+")) if options else {}
    return name, changes, int(size) if size else None


def _options_of(texts: Sequence[str], methods: Sequence[str]) -> Mapping[str, dict[str, str]]:
    """`METHOD:NAME=VALUE` by method."""
    found: dict[str, dict[str, str]] = {}
    for text in texts:
        name, colon, rest = text.partition(":")
        option, equals, value = rest.partition("=")
        if not colon or not equals or name not in methods:
            raise InputError(f"--option {text!r}: write METHOD:NAME=VALUE with one of {', '.join(methods)}")
        found.setdefault(name, {})[option] = value
    return found
