"""The fit of the barge-in probability on odds whose truth is known."""

import numpy as np
import pytest
from scipy.special import expit

from bench import results
from bench.training.probability import (
    HUMAN_SHARE,
    Listened,
    audible,
    curve,
    diagram,
    fitted,
    platt,
    reliability,
    sparing,
    tables,
)
from edgefilter.filter.barge_in import CENTRE, SLOPE, BargeInSettings


@pytest.fixture(scope="module")
def known():
    """Hops whose log-odds say the truth by a logistic of centre 1.5 and slope 0.8 where a quarter of them are human."""
    rng = np.random.default_rng(3)
    odds = rng.uniform(-6, 8, 60_000)
    truth = rng.random(odds.size) < expit(0.8 * (odds - 1.5))
    drop = truth & (rng.random(odds.size) > HUMAN_SHARE * (~truth).sum() / ((1 - HUMAN_SHARE) * truth.sum()))
    odds, truth = odds[~drop], truth[~drop]
    return Listened("real", odds, truth, 256, onset=0, ser=-20.0)


def test_the_fit_is_right_about_odds_whatever_the_share_of_humans(known):
    usual = fitted([known])
    rare = known.human & (np.arange(known.human.size) % 4 > 0)
    fewer = fitted([known._replace(odds=known.odds[~rare], human=known.human[~rare])])
    assert usual == pytest.approx(fewer, abs=0.12)
    assert reliability([known], *usual)["distance"] < 0.02
    assert reliability([known], usual[0] - 2.0, usual[1])["distance"] > 0.1


@pytest.mark.slow
def test_scale_and_bias_bring_the_threshold_of_so_many_false_starts_to_the_filters(known):
    minutes = np.full(300 * 16_000 // 256, -9.0)
    for at, odds in ((5_000, 2.0), (15_000, 3.0)):
        minutes[at : at + 40] = odds
    alone = Listened("real", minutes, np.zeros(minutes.size, bool), 256)
    one, none = (sparing([alone, known], 1.0, 1.2, false_starts) for false_starts in (12, 0))  # an hour
    assert expit(1.2 * (2.0 - 1.0)) < one < expit(1.2 * (2.0 - 1.0)) + 0.01
    assert expit(1.2 * (3.0 - 1.0)) < none < expit(1.2 * (3.0 - 1.0)) + 0.01
    by = platt(1.0, 1.2, one)
    for odds, stops in ((2.0, False), (3.0, True)):
        assert (expit(SLOPE * (by["scale"] * odds + by["bias"] - CENTRE)) > BargeInSettings().threshold) == stops
    same = platt(CENTRE, SLOPE, BargeInSettings().threshold)
    assert same == pytest.approx({"scale": 1.0, "bias": 0.0})


def test_the_curve_counts_false_starts_an_hour_and_who_is_noticed(known):
    minutes = np.full(300 * 16_000 // 256, -9.0)
    for at in (5_000, 15_000):
        minutes[at : at + 40] = 2.0  # logit 1.2 by the fit below: 0.77
    alone = Listened("real", minutes, np.zeros(minutes.size, bool), 256)
    odds = np.where(np.arange(400) >= 105, 9.0, -9.0)  # 5 hops behind the onset
    human = Listened("real", odds, odds > 0, 256, onset=100 * 256, ser=-20.0)
    late = human._replace(odds=np.roll(odds, 60))
    louder = late._replace(ser=0.0)  # not among those that the page tells of
    points = {point["threshold"]: point for point in curve([alone, human, late, louder], 1.0, 1.2)}
    assert points[0.7]["an_hour"] == pytest.approx(24.0, rel=0.01) and points[0.9]["an_hour"] == 0
    assert points[0.97]["noticed"] == 0.5
    found = {
        "centre": 1.0,
        "slope": 1.2,
        "threshold": 0.97,
        **platt(1.0, 1.2, 0.97),
        "before": reliability([human], 3, 1),
        "after": reliability([human], 1, 1),
    }
    drawn = diagram({"real": found})["panels"][0]["lines"]
    assert drawn["real"][1] == [row["share"] for row in found["before"]["rows"]] and len(drawn["right"][0]) == 9
    as_it_is = curve([alone, human, late], 3.25, 1.25)
    curves = {"curve_before": as_it_is, "curve": list(points.values())}
    fits, _, by_threshold = tables({"real": {**found, **curves, "humans": 2, "audible": 1}})
    assert [results.cell(x, 2) for x in fits["rows"][0][:6]] == ["real", "1.00", "1.20", "0.97", "0.96", "2.54"]
    assert [results.cell(x, 0) for x in by_threshold["rows"][1][1:]] == ["0", "50", "24", "50"]
    assert by_threshold["text"].startswith("Of 2 humans 1 can be noticed so soon")


def test_who_begins_with_a_breath_cannot_be_noticed_in_time():
    voice = np.random.default_rng(1).standard_normal(16_000)
    assert audible(np.concatenate((np.zeros(8000), voice)), 8000)
    for breath_s, seen in ((0.2, True), (0.4, False)):
        human = np.concatenate((10 ** (-23 / 20) * voice[: int(breath_s * 16_000)], voice))
        assert audible(human, 0) is seen
