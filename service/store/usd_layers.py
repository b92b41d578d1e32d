"""Files of a USD stage: the root layer and all layers that it composes, inside one folder."""

import posixpath
from pathlib import Path
from typing import Any, Final

from graspd.service.model.errors import InputError
from graspd.service.store.assets import MAX_FILES

LAYERS: Final = (".usd", ".usda", ".usdc")
PACKAGE: Final = ".usdz"
SUFFIXES: Final = (*LAYERS, PACKAGE)


def import_usd(error: type[InputError] = InputError) -> None:
    """Raise `error` unless usd-core is installed."""
    try:
        import pxr.Usd  # noqa: F401
    except ImportError:
        raise error("USD files need usd-core; run pip install 'graspd[usd]'") from None


def layer_files(path: Path) -> dict[str, Path]:
    """Return the layers of a stage by relative name, `path` first; the errors of `open_layers`."""
    if path.suffix.lower() == PACKAGE:
        return {path.name: path}
    import_usd()
    return {name: path.parent / name for name in open_layers(path.resolve().parent, path.name)}


def open_layers(root: Path, main: str) -> dict[str, Any]:
    """Open `main` and the layers that it names, by name relative to `root`, without composing them.
    Missing layers are left out: the variant that needs them may not be selected.
    Raises InputError: a layer is unreadable, or names one outside the folder."""
    from pxr import Sdf, Tf

    found: dict[str, Any] = {}
    waiting = [main]
    while waiting:
        if (name := waiting.pop()) in found or (name != main and not (root / name).is_file()):
            continue
        try:
            layer = Sdf.Layer.FindOrOpen(str(root / name))
        except Tf.ErrorException as error:
            # The reason begins with the name and the line, if the layer is a text.
            raise InputError(f"{name}: {usd_reason(error, root).removeprefix(f'{name}:')}") from None
        if layer is None or len(found) == MAX_FILES:
            raise InputError(f"{name}: no readable USD layer, or one of more than {MAX_FILES}; export it again")
        found[name] = layer
        for reference in filter(None, layer.GetCompositionAssetDependencies()):
            if reference.lower().endswith(".mtlx"):  # Looks without geometry; their reader opens further files.
                layer.UpdateCompositionAssetDependency(reference, "")
            else:
                waiting.append(_resolve(root, name, reference))
    return found


def _resolve(root: Path, layer: str, reference: str) -> str:
    name = posixpath.normpath(posixpath.join(posixpath.dirname(layer), reference.replace("\\", "/")))
    if ":" in reference or not (root / name).resolve().is_relative_to(root.resolve()):
        why = "outside its folder; give the folder that holds both as a ZIP"
    elif not name.lower().endswith(LAYERS):
        why = "which is no USD layer"
    else:
        return name
    raise InputError(f"{layer}: refers to {reference[:100]!r}, {why}, or flatten the stage: usdcat --flatten")


def usd_reason(error: BaseException | str, root: Path) -> str:
    """Return the message of a USD error in one line, without source lines and without the folder `root`."""
    text = " ".join(str(error).split()).replace(f"{root}/", "")
    return text.rpartition(".h : ")[2].rpartition(".cpp : ")[2].strip("' ")[:200]
