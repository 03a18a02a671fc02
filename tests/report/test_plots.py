"""Pictures: drawn, with what was in the data, and one line where they cannot be written."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from edgefilter.echo.model import EchoModel
from edgefilter.errors import EdgefilterError
from edgefilter.profile.approximation import LinearApproximation
from edgefilter.profile.data import Profile
from edgefilter.report.plots import ACCENT, INK, SOFT, plot_before_after, plot_profile
from edgefilter.types import PRE_ROLL


def profile(tap=0.5, warnings=()):
    path = np.zeros(6400, np.float32)
    path[PRE_ROLL] = 1.0
    path[PRE_ROLL + 200] = tap
    flat = np.ones(601, np.float32)
    bands = np.array([[100.0, 200.0], [200.0, 400.0]])
    return Profile(
        EchoModel(path),
        300.0,
        flat / 2,
        flat * 1e-9,
        bands,
        np.array([5.0, 40.0]),
        np.full(4, -50.0),
        warnings=warnings,
    )


def pixels(path):
    return np.asarray(Image.open(path).convert("L"), float)


@pytest.mark.slow
def test_profile_picture_shows_the_profile(tmp_path):
    plot_profile(profile(), tmp_path / "a.png")
    plot_profile(profile(), tmp_path / "b.png")
    plot_profile(profile(tap=-0.5), tmp_path / "c.png")
    a, b, c = (pixels(tmp_path / f"{name}.png") for name in "abc")
    assert a.shape == (880, 1210) and a.std() > 10
    assert np.array_equal(a, b) and not np.array_equal(a, c)


def test_nothing_that_is_written_is_cut_at_the_edge_of_the_picture(tmp_path, monkeypatch):
    """A title was longer than its panel is wide, and its end was missing."""
    drawn = []
    save = Figure.savefig
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, *given, **named: drawn.append(figure) or save(figure, *given, **named)
    )
    loud = replace(profile(warnings=("clipped: 9 samples " * 9,) * 3), distortion_db=np.full(4, -100.0))
    plot_profile(loud, tmp_path / "a.png")
    texts = [
        text for axes in drawn[0].axes for text in (axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label)
    ]
    texts = [text for text in (*texts, drawn[0]._suptitle) if text.get_text()]
    assert len(texts) > 12
    renderer = FigureCanvasAgg(drawn[0]).get_renderer()
    for text in texts:
        box = text.get_window_extent(renderer)
        assert 0 <= box.x0 and box.x1 <= 1210 and 0 <= box.y0 and box.y1 <= 880, text.get_text()


@pytest.mark.slow
def test_what_a_linear_path_leaves_is_drawn_in_three_colours(tmp_path):
    density = np.full((2, 601), 1e-9, np.float32)
    levels = np.array([-26.0, -20.0])
    parts = {name: share * density for name, share in {"noise": 1e-3, "even": 1e-2, "odd": 1e-4}.items()}
    known = LinearApproximation(levels, density, density, **parts, least_db=levels)
    plot_profile(replace(profile(), approximation=known), tmp_path / "a.svg")
    drawn = (tmp_path / "a.svg").read_text()
    plot_profile(profile(), tmp_path / "b.svg")
    assert "a linear path leaves -19.5 dB" in drawn and "even distortion" in drawn
    assert "a linear path" not in (tmp_path / "b.svg").read_text()
    below = drawn[drawn.index("Played at") :]
    assert all(below.count(f"stroke: {colour}") >= 2 for colour in (INK, ACCENT, SOFT))


@pytest.mark.slow
def test_warnings_are_on_the_picture(tmp_path):
    plot_profile(profile(), tmp_path / "a.svg")
    plot_profile(profile(warnings=("clipped: 9 samples",)), tmp_path / "b.svg")
    assert (tmp_path / "b.svg").read_text() != (tmp_path / "a.svg").read_text()
    assert "not to be trusted: clipped" in (tmp_path / "b.svg").read_text()


def test_a_tone_is_bright_where_it_sounds(tmp_path):
    tone = np.zeros(32000, np.float32)
    fade = np.minimum(
        1, np.minimum(np.arange(16000), np.arange(16000)[::-1]) / 1600
    )  # no clicks, which are bright at all frequencies
    tone[16000:] = 0.5 * fade * np.sin(2 * np.pi * 2000 * np.arange(16000) / 16000)
    plot_before_after({"before": tone, "after": np.zeros(32000, np.float32)}, tmp_path / "t.png")
    image = np.asarray(Image.open(tmp_path / "t.png").convert("RGB"), float)
    image = image[:, : round(0.9 * image.shape[1])]  # without the legend
    yellow = (image[..., 0] > 240) & (image[..., 2] < 230) & (image[..., 2] > 100)
    rows, columns = np.nonzero(yellow)
    assert columns.size > 300  # a line of at least one pixel over half the picture
    assert columns.min() > 0.45 * image.shape[1] and np.ptp(rows) < 12


@pytest.mark.slow
@pytest.mark.parametrize("name", ["absent/p.png", "p.nonsense"])
def test_unwritable_picture_is_one_line(tmp_path, name):
    with pytest.raises(EdgefilterError, match="the picture cannot be written") as caught:
        plot_profile(profile(), tmp_path / name)
    assert "\n" not in str(caught.value)
