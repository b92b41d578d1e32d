"""The API explorer: drawn under the policy of the service, from it alone; a request that it sends is answered."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlsplit

import pytest

pytestmark = pytest.mark.browser


@pytest.mark.parametrize(("scheme", "dark"), [("light", False), ("dark", True)])
def test_a_route_is_opened_and_tried(page: Any, scheme: str, dark: bool) -> None:
    hosts = set()
    page.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
    page.emulate_media(color_scheme=scheme)
    page.goto("/docs")
    page.locator("#explorer .opblock").first.wait_for()
    assert page.evaluate("document.documentElement.classList.contains('dark-mode')") is dark
    stats = page.locator("#explorer .opblock", has_text="/v1/stats")
    stats.locator(".opblock-summary-control").click()
    stats.get_by_role("button", name="Try it out").click()
    stats.get_by_role("button", name="Execute").click()
    answer = stats.locator(".live-responses-table td.response-col_status:not(.col_header)")
    answer.wait_for()
    assert answer.inner_text().split()[0] == "200"
    assert len({host for host in hosts if host}) == 1
