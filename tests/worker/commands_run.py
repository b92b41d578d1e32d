"""Commands of graspd as a test runs them."""

import json

from typer.testing import CliRunner

from graspd.cli import build_app


def graspd(words: str, *more: object, code: int = 0) -> dict:
    result = CliRunner().invoke(build_app(), [*words.split(), *(str(word) for word in more), "--json"])
    assert result.exit_code == code, result.output
    return dict(json.loads(result.stdout.splitlines()[-1]))


def refused(words: str, *more: object) -> str:
    """What a command says that ends with 2, as one line."""
    result = CliRunner().invoke(build_app(), [*words.split(), *(str(word) for word in more)])
    assert result.exit_code == 2, result.output
    return " ".join(result.output.split())
