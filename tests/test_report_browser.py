"""The page in a real browser: Debian's Chromium, at desktop and telephone width."""

from __future__ import annotations

import shutil

import pytest
from comparisons import made_up
from pages import watched_page

from colmap_netvlad.report.page import render_page

ARGUMENTS = (
    "--no-sandbox", "--headless", "--disable-gpu", "--disable-dev-shm-usage",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--no-first-run",
)  # fmt: skip

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def browser():
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("Chromium is not here (apt-get install chromium): the page is not opened")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as session:
        started = session.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
        yield started
        started.close()


@pytest.fixture(scope="module")
def address(flight, tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("page") / "compare.html"
    comparison, evidence = made_up(len(flight.names), (3, 6), flight.images, flight.names)
    path.write_text(render_page(comparison, evidence), encoding="utf-8")
    return path.as_uri()


@pytest.fixture(params=[1280, 400], ids=["desktop", "telephone"])
def opened(browser, address, request):
    with watched_page(browser, address, request.param) as page:
        yield page


def test_all_sections_are_shown(opened):
    headings = opened.locator("h2").all_text_contents()
    assert headings == [
        "Summary", "Accuracy and recall over k", "Time", "View graphs", "Models",
        "Retrieval examples", "Pairs only one method found", "Hardest images",
        "How it was measured",
    ]  # fmt: skip
    assert opened.locator("#summary td.best").count() > 3
    assert opened.locator("#graphs img").count() == 3
    assert opened.locator("#models img").count() == 3
    assert opened.locator("#curves svg path").count() > 10
    assert opened.locator("#examples .photo.query").count() >= 1
    assert opened.locator("#examples .photo.wrong").count() >= 1


def test_every_picture_is_drawn(opened):
    sizes = opened.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert len(sizes) > 20 and min(sizes) > 0


def test_only_tables_scroll_sideways(opened):
    assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    outside = opened.evaluate(
        """[...document.querySelectorAll("main *, header *")]
            .filter(e => !e.closest(".scroll, .hidden, svg"))
            .filter(e => e.getBoundingClientRect().right > innerWidth + 1).length"""
    )
    assert outside == 0


def test_the_keyboard_reaches_the_summary_and_its_focus_is_seen(opened):
    opened.keyboard.press("Tab")
    focused = opened.evaluate(
        "[document.activeElement.className, document.activeElement.getBoundingClientRect().left]"
    )
    assert focused[0] == "skip" and focused[1] >= 0
    opened.keyboard.press("Enter")
    opened.keyboard.press("Tab")
    kind, outline = opened.evaluate(
        "[document.activeElement.className, getComputedStyle(document.activeElement).outlineStyle]"
    )
    assert kind == "scroll" and outline == "solid"


def test_dark_mode_and_print_have_colours_of_their_own(browser, address):
    colours = {}
    for scheme in ("light", "dark"):
        page = browser.new_page(color_scheme=scheme)
        page.goto(address)
        colours[scheme] = page.evaluate(
            "[getComputedStyle(document.body).backgroundColor,"
            " getComputedStyle(document.querySelector('#times svg text')).fill]"
        )
        page.emulate_media(media="print", color_scheme=scheme)
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == (
            "rgb(255, 255, 255)"
        )
        assert not page.locator("nav").is_visible()
        page.close()
    assert colours["light"][0] != colours["dark"][0]
    assert colours["light"][1] != colours["dark"][1]


def test_a_photo_called_script_is_a_name(browser, tmp_path):
    hostile = "<img src=x onerror=document.title='run'><script>document.title='run'</script>"
    path = tmp_path / "compare.html"
    names = tuple(f"{hostile}{i}.jpg" for i in range(20))
    path.write_text(render_page(*made_up(20, names=names)), encoding="utf-8")
    with watched_page(browser, path.as_uri(), 1280) as page:
        title = page.title()
        assert title and title != "run"
        assert hostile in page.inner_text("main")
