"""The report in a browser: switches move the figures, nothing is clipped, nothing is loaded, nothing complains, it prints."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.recording import Recording, diagnose
from edgefilter.diagnosis.result import Finding
from edgefilter.report.html import comparison_page, diagnosis_page, write_page
from tests.diagnosis.robot_scene import profile, record, voice
from tests.live.browser import Browser

pytestmark = pytest.mark.slow

NAMES = {
    "profile": "a robot with a rather long name.npz",
    "recording": "the office <on> Monday.wav",
    "reference": "tts.wav",
    "effects": [],
}
CLIPPED = """[...document.querySelectorAll('body *')].filter((e) => e.checkVisibility() && !e.closest('audio')).flatMap((e) => {
  const r = e.getBoundingClientRect(), wide = document.documentElement.clientWidth;
  const outside = r.width && (r.right > wide + 0.5 || r.left < -0.5);
  const cut = getComputedStyle(e).overflowX !== 'visible' && e.scrollWidth > e.clientWidth + 1;
  return outside || cut ? [e.tagName + '.' + e.className + ' ' + e.textContent.slice(0, 40)] : []; })"""
CONTRAST = """(() => {
  const parts = (c) => c.match(/[\\d.]+/g).map((v, i) => c.startsWith('color(') && i < 3 ? 255 * v : Number(v));
  const ground = (e) => { for (; e; e = e.parentElement) { const c = parts(getComputedStyle(e).backgroundColor); if (c[3] !== 0) return c; } };
  const light = (c) => c.slice(0, 3).map((v) => v / 255).map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const texts = [...document.querySelectorAll('body *')].filter((e) => e.checkVisibility()
    && [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim()));
  return Object.fromEntries(texts.map((e, i) => {
    const [a, b] = [light(parts(getComputedStyle(e).color)), light(ground(e))].sort((x, y) => y - x);
    return [i + ' ' + e.textContent.trim().slice(0, 30), (a + 0.05) / (b + 0.05)]; })); })()"""
OVERLAPPING = """[...document.querySelectorAll('.frame')].flatMap((frame) => ['.under', '.step', '.amount', '.tick'].flatMap((kind) => {
  const all = [...frame.querySelectorAll(kind)].map((e) => [e.getBoundingClientRect(), e.textContent]);
  return all.flatMap(([a, x], i) => all.slice(i + 1).filter(([b]) =>
    a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1).map(([, y]) => x + ' | ' + y)); }))"""


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """The folder with a diagnosis of two effects, a comparison, and a diagnosis that found nothing.

    And the first one's figures.
    """
    folder = tmp_path_factory.mktemp("pages")
    x, robot = voice(6.0), profile()
    wrong = robot.echo.with_effect("playback_gain", {"gain_db": -3.0}).with_effect("speaker_nonlinearity", {"odd": 4.0})
    y = record(x, wrong)
    found = diagnose(robot, y, x, criteria=Criteria(false_rate=0.05))  # a distortion that is near the floor
    assert [finding.effect for finding in found.ranking] == ["playback_gain", "speaker_nonlinearity"]
    recording = Recording(y, x, robot)
    write_page(folder / "missing.html", diagnosis_page(recording, found, NAMES))
    proof = recording.prove([finding.effect for finding in found.ranking])
    write_page(folder / "proved.html", diagnosis_page(recording, found, NAMES, proof=proof))
    write_page(folder / "comparison.html", comparison_page(found.comparison, NAMES))
    neutral = [Finding(name, "dynamics", 1.0, 0.0, 0.0, 0.0, {}, "", {}, y) for name in ("compression", "clock_drift")]
    model = found.model.with_effect("compression", {}).with_effect("clock_drift", {})
    many = replace(found, ranking=(*found.ranking, *neutral), model=model)
    write_page(folder / "many.html", diagnosis_page(Recording(y, x, robot), many, NAMES))
    clean = record(x)
    write_page(folder / "explained.html", diagnosis_page(Recording(clean, x, robot), diagnose(robot, clean, x), NAMES))
    return folder, found


@pytest.fixture(scope="module")
def browser():
    with Browser() as found:
        yield found


def shown_excess(browser) -> float:
    return float(browser.run("document.getElementById('excess').textContent").split()[0].replace("−", "-"))


def stored(folder) -> dict:
    page = (folder / "missing.html").read_text()
    return json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])


def test_switches_move_the_figure_the_stairs_the_bars_the_picture_and_the_sound(browser, pages):
    folder, found = pages
    data = stored(folder)
    browser.open(folder / "missing.html", 1280)
    state = """[...document.querySelectorAll('.now-bar')].reduce((sum, e) => sum + parseFloat(e.style.height), 0)"""
    pieces = (
        "['residual', 'prediction'].flatMap((id) => ['img', 'audio'].map((e) => document.querySelector(`#${id}"
        " ${e}`).getAttribute('src')))"
    )
    steps = (  # less the first and the last column, each with its irreducible part
        "document.querySelectorAll('.stair').length - 4"
    )
    heights, sources = {}, {}
    for key, clicked in (("11", None), ("01", 0), ("00", 1), ("10", 0)):
        if clicked is not None:
            browser.click(f"#switches [data-effect='{clicked}']")
        now = data["variants"][key]
        assert shown_excess(browser) == pytest.approx(now["excess_db"], abs=0.051)  # one decimal is shown
        kept = [data["media"][now[part][kind]] for part in ("residual", "prediction") for kind in ("picture", "sound")]
        assert browser.run(pieces) == kept
        heights[key], sources[key] = browser.run(state), tuple(kept)
        assert browser.run(steps) == key.count("1")
        assert f"{abs(now['excess_db']):.1f} dB" in browser.run("document.querySelector('#staircase .plot').ariaLabel")
    assert len(set(sources.values())) == 4
    last = "drawStaircase([true, true]), [...document.querySelectorAll('.amount')].at(-1).textContent"
    for irreducible_db, left in ((0, "−0.2"), (8, "8.0")):
        browser.run(f"data.irreducible_db = {irreducible_db}, data.variants['11'].excess_db = -0.2")
        assert browser.run(last) == left
    assert heights["11"] < 0.3 * heights["00"]
    gain, bent = found.ranking
    for key, expected in (("00", gain.excess_before_db), ("10", gain.excess_after_db), ("11", found.remaining_db)):
        assert data["variants"][key]["excess_db"] == pytest.approx(expected, abs=0.002), (
            key
        )  # three decimals are stored
    assert bent.excess_before_db == gain.excess_after_db
    assert browser.console == []


def test_of_many_effects_the_later_ones_are_switched_with_the_earlier(browser, pages):
    folder, _ = pages
    browser.open(folder / "many.html", 1280)
    states = "[...document.querySelectorAll('#switches input')].map((box) => +box.checked).join('')"
    for clicked, expected in ((1, "1000"), (2, "1110"), (0, "0000"), (3, "1111")):
        browser.click(f"#switches [data-effect='{clicked}']")
        assert browser.run(states) == expected
    assert browser.console == []


def test_it_is_worked_without_a_mouse(browser, pages):
    folder, _ = pages
    data = stored(folder)
    browser.open(folder / "missing.html", 1280)
    browser.press("Tab", 9)
    assert browser.run("document.activeElement.dataset.effect") == "0"
    assert browser.run("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    browser.press(" ", 32, " ")
    assert shown_excess(browser) == pytest.approx(data["variants"]["01"]["excess_db"], abs=0.051)
    unnamed = (
        "[...document.querySelectorAll('input, audio, img, [role=img]')].filter((e) => !(e.labels?.length ||"
        " e.ariaLabel || e.alt)).length"
    )
    assert browser.run(unnamed) == 0


def test_what_the_running_filter_leaves_is_drawn_and_played_from_where_it_begins(browser, pages):
    folder, _ = pages
    browser.open(folder / "proved.html", 1280)
    browser.wait("[...document.querySelectorAll('audio')].every((a) => a.readyState >= 1)")
    before, after = browser.run("['before', 'after'].map((id) => document.querySelector(`#${id} audio`).duration)")
    begins = browser.run("data.filtered.from_s")
    assert before == after == pytest.approx(6.0 - begins, abs=0.1)  # Opus pads to whole packets
    assert float(browser.run("document.querySelector('#after .under').textContent")) >= begins


def test_sound_plays_and_the_residual_is_at_its_true_level(browser, pages):
    folder, found = pages
    browser.open(folder / "missing.html", 1280)
    browser.wait("[...document.querySelectorAll('audio')].every((a) => a.readyState >= 1)")
    lengths = browser.run("[...document.querySelectorAll('audio')].map((a) => a.duration)")
    np.testing.assert_allclose(lengths, 6.0, atol=0.1)  # Opus pads to whole packets
    volume = "document.querySelector('#residual audio').volume"
    assert browser.run(volume) == pytest.approx(0.1)
    browser.click("#louder")
    assert browser.run(volume) == 1.0
    browser.run("document.querySelector('#recording audio').play()")
    browser.wait("parseFloat(document.querySelector('#recording .cursor').style.left) > 0")


@pytest.mark.parametrize("width", [360, 768, 1280])
@pytest.mark.parametrize("page", ["missing", "proved", "many", "comparison", "explained"])
def test_nothing_is_clipped_or_overlaps_at_any_width(browser, pages, page, width):
    folder, _ = pages
    browser.open(folder / f"{page}.html", width)
    browser.run("document.querySelector('details').open = true")
    assert browser.run("document.documentElement.scrollWidth") <= width
    assert browser.run(CLIPPED) == []
    assert browser.run(OVERLAPPING) == []
    assert browser.console == []


@pytest.mark.parametrize("dark", [False, True])
def test_every_text_stands_out_from_its_ground(browser, pages, dark):
    folder, _ = pages
    browser.open(folder / "missing.html", 1280, dark=dark)
    contrasts = browser.run(CONTRAST)
    assert len(contrasts) > 50
    assert min(contrasts.values()) >= 4.5, min(contrasts, key=contrasts.get)  # WCAG 2.2, 1.4.3
    assert browser.run("getComputedStyle(document.body).backgroundColor").startswith("rgb(2" if not dark else "rgb(21")


def test_the_checks_see_what_they_look_for(browser, pages):
    folder, _ = pages
    browser.open(folder / "missing.html", 360)
    browser.run("document.querySelector('h2').style.width = '500px'")
    assert any("H2" in found for found in browser.run(CLIPPED))
    browser.run("document.querySelectorAll('#bands .under').forEach((e) => (e.style.left = '50%'))")
    assert browser.run(OVERLAPPING)
    browser.run("setTimeout(() => { throw new Error('thrown here'); }, 0)")
    browser.run("new Promise((done) => setTimeout(done, 50))")
    assert any("thrown here" in line for line in browser.console)
    browser.console.clear()


def test_no_request_leaves_the_file(browser, pages):
    folder, _ = pages
    browser.requests.clear()
    for page in sorted(folder.glob("*.html")):
        browser.open(page, 1280)
    assert len(browser.requests) >= 3
    assert all(url.startswith(("file:", "data:")) for url in browser.requests), browser.requests


def test_only_what_applies_is_shown(browser, pages):
    folder, _ = pages
    shown = "(s) => document.querySelector(s).checkVisibility()"
    for page, expected in (
        ("missing", [True, True, True]),
        ("explained", [False, True, False]),
        ("comparison", [False, False, False]),
    ):
        browser.open(folder / f"{page}.html", 1280)
        assert [browser.run(f"({shown})('{part}')") for part in ("#switches", "#budget", "#found")] == expected, page
    assert "the office <on> Monday.wav" in browser.run("document.body.innerText")


def test_it_prints(browser, pages):
    folder, _ = pages
    browser.open(folder / "missing.html", 1280)
    document = browser.pdf()
    assert document.startswith(b"%PDF") and 2 <= document.count(b"/Type /Page\n") <= 5
    assert len(document) > 50_000, "the spectrograms are in it"
    browser.call("Emulation.setEmulatedMedia", media="print")
    assert browser.run("[...document.querySelectorAll('audio, #louder')].some((e) => e.checkVisibility())") is False
    browser.call("Emulation.setEmulatedMedia", media="")


def test_the_file_of_half_a_minute_stays_small(pages):
    folder, _ = pages
    assert (folder / "missing.html").stat().st_size * 30 / 6 < 8e6
