"""A page in a real browser, watched."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def watched_page(browser: Any, address: str, width: int) -> Iterator[Any]:
    """Open a page; in the end nothing was wrong in it, and no request left it."""
    page = browser.new_page(viewport={"width": width, "height": 900})
    faults, requests = [], []
    page.on("console", lambda message: faults.append(message.text))
    page.on("pageerror", lambda fault: faults.append(str(fault)))
    page.on("request", lambda asked: requests.append(asked.url))
    page.goto(address)
    yield page
    assert faults == []
    assert [url for url in requests if not url.startswith("data:")] == [address]
    page.close()
