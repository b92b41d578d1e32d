import pytest

from graspd.service.model.errors import InputError
from graspd.worker.validation.engines.registry import ENGINES, check_engines


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    try:
        check_engines([request.param])
    except InputError as missing:
        pytest.skip(str(missing))
    return str(request.param)
