"""What is found of an option where the table has one row more than ours: `python -m tests.one_more_option FOLDER`.

A process of its own: what follows from the table is made when the modules that need it are imported. Prints the
findings as JSON.
"""

import inspect
import json
import sys
from importlib.util import find_spec, module_from_spec
from pathlib import Path

NAME, FLAG, MEANING = "finger_force", "--finger-force", "largest force of a finger [N]"
ROW = f"""
    {NAME}: Annotated[float, Option(), Form("grasps", "Finger force", "of each finger", cells=True)] = _sparse(
        5.0, ge=1, le=20, description="{MEANING}"
    )
"""
#: The row stands before the first rule of the table.
_BEFORE = '\n    @field_validator("fidelity")'


def add_row() -> None:
    """Import the table as if the row stood in its file."""
    spec = find_spec("graspd.service.model.domain")
    assert spec is not None and spec.origin is not None
    source = Path(spec.origin).read_text()
    assert source.count(_BEFORE) == 1
    module = sys.modules[spec.name] = module_from_spec(spec)
    exec(compile(source.replace(_BEFORE, ROW + _BEFORE), spec.origin, "exec"), module.__dict__)


def main(folder: Path) -> None:
    add_row()
    from fastapi.testclient import TestClient
    from typer.testing import CliRunner

    import graspd
    from graspd.api.app import create_app
    from graspd.cli import build
    from graspd.service.docs import keywords_stub, options_table
    from graspd.service.settings import Settings
    from tests.api.conftest import BASE_URL
    from tests.indexes import open_services

    def command(*words: str) -> str:
        return CliRunner().invoke(build(), [*words], env={"COLUMNS": "200"}).output

    pair = ("--hand", "barrett", "--object", "block")
    services = open_services(Settings(data_dir=folder))
    with TestClient(create_app(services.settings, services), base_url=BASE_URL) as http:
        schemas = http.get("/openapi.json").json()["components"]["schemas"]
        found = {
            "help": [command(*name.split(), "--help") for name in ("synth", "submit", "datasets create")],
            "out of bounds": [
                command("synth", *pair, "-o", str(folder / "g.h5"), FLAG, "50"),
                command("submit", *pair, FLAG, "50"),
                http.post("/v1/jobs", json={"hand": "barrett", "object": "block", NAME: 50}).json()["detail"],
            ],
            "forms": [http.get("/submit").text, http.get("/datasets").text],
            "http": [schemas[name]["properties"].get(NAME) for name in ("JobRequest", "DatasetRequest")],
            "python": [
                str(inspect.signature(one).parameters.get(NAME)) for one in (graspd.synthesize, graspd.Client.submit)
            ],
            "types": keywords_stub(),
            "docs": options_table(),
            "warp": "warp" in sys.modules,
        }
    services.close()
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
