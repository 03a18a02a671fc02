"""The page of the evaluation in a browser: nothing outside the window, nothing loaded, sound and tables there, who is best in bold."""

from __future__ import annotations

import pytest

from bench.evaluate import page, slices, table, worst
from edgefilter.report.html import write_page
from tests.bench.conftest import babble
from tests.bench.evaluated import results
from tests.live.browser import Browser
from tests.live.test_report import CONTRAST

STAMP = {
    "date": "2026-11-22 05:00 UTC",
    "commit": "0123456789abcdef",
    "dirty": False,
    "command": "python -m bench FOLDER",
    "data": [{"what": "recordings", "folder": "two", "files": 14, "sha256": "ab" * 32}],
    "models": {},
    "machine": {"processor": "one"},
}


def clip(made, index: int) -> dict:
    row = made.rows[index]
    pieces = [worst._piece(name, babble(2.0, index)) for name in ("Microphone", "crnn", "The human alone")]
    shown = {
        "name": f"{made.clips[index].name}, paper",
        "said": "ten <b>words</b>",
        "facts": row["facts"],
        "pieces": pieces,
    }
    heard = worst.heard_by(made, index)
    return shown | {"heard": heard, "seconds": 2.0, "human_s": 0.5, "diagnosis": "The profile explains it."}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    made = results()
    content = {"groups": table.content(made), "absent": {"VoiceFilter": "no package carries its weights"}}
    content |= {"slices": slices.slices(made), "conclusions": slices.conclusions(made)}
    path = tmp_path_factory.mktemp("evaluation") / "evaluation.html"
    write_page(path, page.page(made, content, [clip(made, index) for index in worst.worst(made, 2)], STAMP))
    return path


@pytest.fixture(scope="module")
def browser():
    with Browser() as found:
        yield found


@pytest.mark.parametrize("width", [360, 1280])
def test_it_fits_loads_nothing_and_does_not_complain(browser, file, width):
    browser.requests.clear()
    browser.open(file, width)
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.console == []
    assert all(url.startswith(("file:", "data:")) for url in browser.requests)


def test_who_is_best_is_bold_and_the_dots_stand_where_the_figures_are(browser, file):
    browser.open(file, 1280)
    headline = "crnn, calibrated has the fewest word errors in 2 of 2 tables"
    assert browser.run("document.querySelector('h1').textContent") == headline
    cells = "[...document.querySelectorAll('.group:first-of-type tbody tr')].map((row) => [row.querySelector('th').textContent, "
    rows = browser.run(
        cells
        + "row.children[3].className, parseFloat(row.children[3].textContent), row.querySelector('.dot')?.style.left])"
    )
    by = {row[0]: row[1:] for row in rows}
    assert [name for name, row in by.items() if row[0] == "best"] == ["crnn, calibrated"]
    assert by["WebRTC AEC3, told the true lag"][1] < by["crnn, calibrated"][1]  # better, and not bold
    for _, value, left in by.values():
        assert float(left.rstrip("%")) == pytest.approx(value, abs=0.6)  # shown without decimals


def test_the_worst_can_be_heard_and_seen(browser, file):
    browser.open(file, 1280)
    browser.wait("[...document.querySelectorAll('audio')].every((a) => a.readyState >= 1)")
    assert browser.run("[...document.querySelectorAll('audio')].map((a) => Math.round(a.duration))") == [2] * 6
    assert browser.run("document.querySelector('.said').textContent") == "ten <b>words</b>"
    assert browser.run("document.querySelector('.onset').style.left") == "25%"
    assert "<" in browser.run("document.querySelector('.heard').innerText")
    assert "no package carries its weights" in browser.run("document.querySelector('#absent').innerText")


@pytest.mark.parametrize("dark", [False, True])
def test_every_text_stands_out_from_its_ground(browser, file, dark):
    browser.open(file, 1280, dark=dark)
    browser.run("document.querySelectorAll('.heat td').forEach((e) => e.style.setProperty('--bad', '100%'))")
    tints = browser.run("[...document.querySelectorAll('.heat td')].map((e) => getComputedStyle(e).backgroundColor)")
    assert tints and all(tint.startswith("color(srgb") for tint in tints)  # the check below sees the strongest one
    contrasts = browser.run(CONTRAST)
    assert len(contrasts) > 100 and min(contrasts.values()) >= 4.5, min(contrasts, key=contrasts.get)
