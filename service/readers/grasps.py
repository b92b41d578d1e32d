"""Grasps of base shards, one by one or as arrays."""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.readers.files import ShardFile, Shards
from graspd.service.store import validity
from graspd.service.store.columns import SCHEMAS, check_column_names
from graspd.service.store.shards import open_shard, read_column

Array = NDArray[Any]
#: Function from the columns of one base shard to a mask (N,) of selected grasps.
Where = Callable[[Mapping[str, Array]], Array]

DEFAULT_COLUMNS: Final = (
    *(f"{posture}/{part}" for posture in ("grasp", "pregrasp", "squeeze") for part in ("hand_pose", "joint_positions")),
    *("quality/epsilon", "quality/contact_area_cm2", "quality/penetration_depth_mm", "quality/valid"),
)
#: Number of shards cached in memory: about 0.1 MB each.
_KEPT: Final = 256


class Grasps(Sequence[dict[str, Any]]):
    """Grasps of base shards; `grasps[i]` is a dict of column rows and `hand`, `object`, `shard_id`, `row`.

    docs/reference/dataset.md describes the columns. Swept metrics have one value per contact threshold of the shard.
    """

    def __init__(
        self,
        shards: Shards,
        columns: Sequence[str] = DEFAULT_COLUMNS,
        *,
        valid: bool = True,
        unvalidated: bool = False,
        where: Where | None = None,
    ) -> None:
        """Read every base shard once, to select the rows.

        Args:
            shards: result of `open_shards`; only base shards count.
            columns: columns of a sample.
            valid: select only valid grasps: feasible and held by a validator.
            unvalidated: select instead only feasible grasps without validation.
            where: function of the columns that returns a mask, for further selection.

        Raises InputError for an unknown column, or a mask of wrong length.
        """
        check_column_names("base", columns)
        self.shards, self.columns = shards, tuple(columns)
        self._valid, self._unvalidated, self._where = valid, unvalidated, where
        self._files = shards.of_kind("base")
        self._memory: OrderedDict[str, dict[str, Array]] = OrderedDict()
        self._rows = [self._selected_rows(file) for file in self._files]
        #: (shards,) index after the last grasp of each base shard.
        self.ends = np.cumsum([len(rows) for rows in self._rows], dtype=np.int64)

    def __len__(self) -> int:
        return int(self.ends[-1]) if len(self.ends) else 0

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        at = index + len(self) if index < 0 else index
        if not 0 <= at < len(self):
            raise IndexError(index)
        number = int(np.searchsorted(self.ends, at, side="right"))
        rows, file = self._rows[number], self._files[number]
        row = int(rows[at - (int(self.ends[number]) - len(rows))])
        held = self._load(file, self.columns)
        sample: dict[str, Any] = {name: held[name][row] for name in self.columns}
        return sample | {"hand": file.hand, "object": file.object, "shard_id": file.id, "row": row}

    def joint_names(self, hand: str) -> list[str]:
        """Return joint names in the order of `joint_positions`; InputError if no shard has the hand."""
        for file in self._files:
            if file.hand == hand:
                with open_shard(self.shards.path(file)) as opened:
                    return [str(name) for name in opened.attrs["joint_names"]]
        raise InputError(f"no shard is of the hand {hand!r}")

    def arrays(self, *columns: str) -> dict[str, Array]:
        """Return columns of all grasps, by default `columns`; InputError unless they fit into one array."""
        wanted = columns or self.columns
        parts: dict[str, list[Array]] = {name: [] for name in (*wanted, "hand", "object")}
        for file, rows in zip(self._files, self._rows, strict=True):
            held = self._load(file, wanted)
            for name in wanted:
                parts[name].append(held[name][rows])
            parts["hand"].append(np.full(len(rows), file.hand))
            parts["object"].append(np.full(len(rows), file.object))
        try:
            return {name: np.concatenate(some) if some else np.empty(0) for name, some in parts.items()}
        except ValueError as error:
            hint = "read one hand: shards.select(...)"
            raise InputError(f"the shards do not fit into one array ({error}); {hint}") from None

    def _selected_rows(self, file: ShardFile) -> NDArray[np.intp]:
        held = self._load(file, tuple(SCHEMAS["base"]) if self._where else validity.COLUMNS, keep=False)
        if self._valid or self._unvalidated:
            mask = validity.selection_mask(held, unvalidated=self._unvalidated)
        else:
            mask = np.ones(len(held["quality/valid"]), bool)
        if self._where is not None:
            found = np.asarray(self._where(held), bool)
            if found.shape != mask.shape:
                raise InputError(f"`where` gave a mask of shape {found.shape} for {len(mask)} grasps")
            mask &= found
        return np.flatnonzero(mask)

    def _load(self, file: ShardFile, columns: Sequence[str], *, keep: bool = True) -> dict[str, Array]:
        held = self._memory.get(file.id, {})
        if missing := [name for name in columns if name not in held]:
            with open_shard(self.shards.path(file)) as opened:
                held = held | {name: read_column(opened, name, file.id) for name in missing if name in opened}
            may_lack = {name for name, column in SCHEMAS["base"].items() if column.optional and not keep}
            if absent := [name for name in columns if name not in held and name not in may_lack]:
                raise InputError(f"shard {file.id[:12]} of {file.hand} on {file.object} has no column {absent[0]!r}")
            if keep:
                self._memory[file.id] = held
                if len(self._memory) > _KEPT:
                    self._memory.popitem(last=False)
        return held
