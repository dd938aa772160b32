"""A flight's quality page in a real browser: table, search, map, and nothing but our script."""

from __future__ import annotations

from pathlib import Path

import pytest
from models import grid_model
from pages import watched_page
from test_report_browser import browser

from colmap_netvlad.report.flight_page import render_flight_page
from colmap_netvlad.report.quality import Source, judge, measure

pytestmark = pytest.mark.browser
__all__ = ["browser"]

SCRIPT = "<img src=x onerror=document.title='run'><script>document.title='run'</script>.jpg"


@pytest.fixture(scope="module")
def address(tmp_path_factory) -> str:
    names = (SCRIPT, *(f"DJI_{i:04d}.jpg" for i in range(1, 100)))
    model = grid_model(10, names=names)
    centres = {image.name: image.projection_center() for image in model.images.values()}
    title = "<script>document.title='run'</script>"
    quality = measure(Source(title, model, Path("m"), positions=centres))
    path = tmp_path_factory.mktemp("quality") / "report.html"
    path.write_text(render_flight_page(quality, judge(quality)), encoding="utf-8")
    return path.as_uri()


@pytest.fixture(params=[1280, 400], ids=["desktop", "telephone"])
def opened(browser, address, request):
    with watched_page(browser, address, request.param) as page:
        yield page
        assert page.title().startswith("Quality report of <script>")


def rows(page) -> list[str]:
    return page.locator("#rows tbody tr[data-i] th").all_text_contents()


def column(page, number: int) -> list[float]:
    cells = page.locator(f"#rows tbody tr[data-i] td:nth-child({number})").all_text_contents()
    return [float(text.replace(",", "")) for text in cells if text != "–"]


def test_table_sorts_by_every_column_both_ways(opened):
    assert rows(opened)[:2] == [SCRIPT, "DJI_0001.jpg"]
    heads = opened.locator("#rows thead th")
    for number in range(3, heads.count() + 1):
        button = heads.nth(number - 1).locator("button")
        for way in ("ascending", "descending"):
            button.click()
            assert heads.nth(number - 1).get_attribute("aria-sort") == way
            values = column(opened, number)
            assert len(values) > 10
            assert values == sorted(values, reverse=way == "descending")
    assert opened.locator("#rows thead th[aria-sort]").count() == 1


def test_table_holds_only_the_rows_in_view_and_scrolls_to_all(opened):
    seen = set(rows(opened))
    assert len(seen) < 60
    for top in range(0, 3200, 300):
        opened.evaluate(f"document.getElementById('rows').scrollTop = {top}")
        opened.wait_for_timeout(40)
        seen.update(rows(opened))
    assert len(seen) == 100


def test_search_finds_names_and_states(opened):
    opened.fill("#search", "dji_009")
    assert rows(opened) == [f"DJI_{i:04d}.jpg" for i in range(90, 100)]
    assert opened.locator("#found").text_content() == "10 of 100 photos"
    opened.fill("#search", "REGISTERED")
    assert opened.locator("#found").text_content() == "100 of 100 photos"
    opened.fill("#search", "onerror=")
    assert rows(opened) == [SCRIPT]
    opened.fill("#search", "nothing like it")
    assert rows(opened) == []


def picture(page) -> str:
    return page.evaluate("document.getElementById('map').toDataURL()")


def test_map_shows_the_photo_that_is_clicked(opened):
    opened.locator("#map").scroll_into_view_if_needed()
    opened.wait_for_function("document.getElementById('map').width > 300")
    before = picture(opened)
    opened.fill("#search", "DJI_0055")
    opened.locator("#rows tbody tr[data-i] th").first.click()
    assert opened.locator("#picked strong").text_content() == "DJI_0055.jpg"
    assert "Strongest pairs: DJI_00" in opened.locator("#picked").text_content()
    assert picture(opened) != before
    opened.fill("#search", "")
    box = opened.locator("#map").bounding_box()
    # Photo 0 is the most south-western of the grid: look for it in that corner.
    for share in (0.02, 0.06, 0.1, 0.14, 0.18, 0.22, 0.26, 0.3, 0.34, 0.38):
        side = min(box["width"], box["height"])
        left = box["x"] + (box["width"] - side) / 2 + share * side
        top = box["y"] + (box["height"] + side) / 2 - share * side
        opened.mouse.click(left, top)
        if opened.locator("#picked strong").text_content() == SCRIPT:
            break
    assert opened.locator("#picked strong").text_content() == SCRIPT
    assert opened.locator("#rows tr.chosen th").text_content() == SCRIPT


def test_map_layers_and_zoom_change_the_picture(opened):
    opened.locator("#map").scroll_into_view_if_needed()
    seen = {picture(opened)}
    for control in ("layer-overlap", "layer-pairs", "layer-footprints", "zoom-in", "zoom-fit"):
        opened.locator(f"#{control}").click()
        opened.wait_for_timeout(60)
        seen.add(picture(opened))
    assert len(seen) >= 5


def test_arrow_keys_move_the_choice(opened):
    opened.locator("#rows").focus()
    for key, name in (("ArrowDown", SCRIPT), ("ArrowDown", "DJI_0001.jpg"), ("ArrowUp", SCRIPT)):
        opened.keyboard.press(key)
        assert opened.locator("#picked strong").text_content() == name


def test_only_tables_scroll_sideways(opened):
    assert opened.evaluate("document.documentElement.scrollWidth <= innerWidth")
    sizes = opened.evaluate("[...document.images].map(image => image.naturalWidth)")
    assert len(sizes) >= 4 and min(sizes) > 0


def test_print_shows_every_row(browser, address, tmp_path):
    page = browser.new_page()
    page.goto(address)
    page.evaluate("window.dispatchEvent(new Event('beforeprint'))")
    assert len(rows(page)) == 100
    page.evaluate("window.dispatchEvent(new Event('afterprint'))")
    assert len(rows(page)) < 60
    page.close()


def test_page_without_points_and_pictures_opens_without_a_fault(browser, tmp_path):
    import pycolmap

    for name, model in (("empty", pycolmap.Reconstruction()), ("one", grid_model(1))):
        quality = measure(Source(name, model, Path("m")))
        (tmp_path / name).with_suffix(".html").write_text(
            render_flight_page(quality, judge(quality))
        )
        page, faults = browser.new_page(), []
        page.on("console", lambda message, faults=faults: faults.append(message.text))
        page.on("pageerror", lambda fault, faults=faults: faults.append(str(fault)))
        page.goto((tmp_path / name).with_suffix(".html").as_uri())
        assert page.locator("#found").text_content() == (
            "0 of 0 photos" if name == "empty" else "1 of 1 photos"
        )
        assert faults == []
        page.close()
