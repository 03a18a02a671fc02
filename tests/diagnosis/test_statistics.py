"""All that was tried, and how well the numbers are known."""

from __future__ import annotations

import json

import numpy as np
import pytest

from edgefilter.commands.display import write_json
from edgefilter.diagnosis.criteria import Criteria
from edgefilter.diagnosis.diagnose import conclude
from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.result import Known, Precision
from edgefilter.diagnosis.select import search
from edgefilter.diagnosis.trials import Found, Workbench
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.measurement import Measurement
from edgefilter.report.text import candidate_lines, diagnosis_lines, error_text, independence_lines, precision_lines
from tests.diagnosis.robot_scene import profile, record, voice

GAIN_DB = -2.0


@pytest.fixture(scope="module")
def diagnosed():
    """A robot whose volume was turned down, and the diagnosis of it for which every effect is fitted, whatever a simpler one explains."""
    x, robot = voice(6.0), profile()
    prepared = prepare(robot, record(x, robot.echo.with_effect("playback_gain", {"gain_db": GAIN_DB})), x)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Workbench, "_settles", lambda *_: False)
        return x, prepared, conclude(prepared, search(prepared, prepared.model, Criteria()), Criteria())


@pytest.mark.slow
def test_every_effect_that_was_fitted_is_in_the_table_with_its_fate(diagnosed):
    tried = diagnosed[2].tried
    by_name = {row.effect: row for row in tried}
    assert by_name["playback_gain"].verdict == "named" and by_name["playback_gain"].gain_db > 3
    assert len(tried) > 8 and len(by_name) == len(tried)
    assert by_name["clock_drift"].verdict == "below its bar" and by_name["clock_drift"].why
    ranked = [row for row in tried if row.rank is not None]
    assert [row.rank for row in ranked] == list(range(1, len(ranked) + 1))
    gains = [row.beside_db if row.gain_db is None else row.gain_db for row in ranked]
    assert gains == sorted(gains, reverse=True)
    text = "\n".join(candidate_lines(tried))
    assert all(row.effect in text for row in tried)


def test_what_a_simpler_effect_leaves_nothing_to_is_spared_and_said(diagnosed):
    _, prepared, thorough = diagnosed
    quick = conclude(prepared, search(prepared, prepared.model, Criteria()), Criteria())
    ((found, known),) = zip(quick.ranking, thorough.ranking, strict=True)
    assert found.effect == known.effect == "playback_gain" and found.values == known.values
    assert quick.remaining_db == thorough.remaining_db
    fates = {row.effect: (row.verdict, row.why) for row in quick.tried}
    assert (
        fates["late_reverb"] == fates["compression"] == ("not fitted", "what is left is too little for it to be named")
    )
    assert len(fates) == len(quick.tried) == len(thorough.tried)


def test_the_standard_error_is_the_scatter_of_fits_to_other_noise(diagnosed):
    """0.5 to 2: the scatter of 12 fits is itself known to a fifth, the error from a dozen blocks to about the same."""
    x, prepared, found = diagnosed
    (known,) = found.precision.numbers
    assert known.label == "playback_gain.gain_db" and known.source == "jacobian"
    robot, effect = profile(), find("playback_gain")
    turned = robot.echo.with_effect("playback_gain", {"gain_db": GAIN_DB})
    clean = turned.predict(prepared.measurement.reference)
    rng = np.random.default_rng(1)
    fits = []
    for _ in range(12):
        noisy = clean + (1e-3 * rng.standard_normal(x.size)).astype(np.float32)
        other = Measurement(prepared.measurement.reference, noisy, prepared.noise_psd, prepared.fit)
        fits.append(effect.fit(other, robot.echo)["gain_db"])
    assert 0.5 < known.error / np.std(fits, ddof=1) < 2.0


def test_an_interval_holds_the_truth_in_nine_of_ten_recordings():
    """At least 85 % of 24 intervals; a ring's fit ends short of the least error, and a clipper's thirds were all alike: 17 of 24 did."""
    held = []
    for effect, truth in {
        "chassis_resonance": {"frequency_hz": 640.0, "q": 35.0, "gain_db": -2.0},
        "mic_clipping": {"level": 0.06},
    }.items():
        for seed in range(6):
            x, robot = voice(12.0, seed), profile()
            prepared = prepare(robot, record(x, robot.echo.with_effect(effect, truth), seed=100 + seed), x)
            bench = Workbench(prepared, Criteria())
            step = bench.attempt(effect, prepared.model)
            found = Found(prepared, prepared.model, step.model, bench.score(prepared.model), step.score, (step,))
            known = conclude(prepared, found, Criteria()).ranking[0].parameters
            held += [known[name].low <= value <= known[name].high for name, value in truth.items()]
    assert np.mean(held) >= 0.85 and len(held) == 24


def test_the_text_says_all_of_it(diagnosed):
    found = diagnosed[2]
    text = "\n".join(diagnosis_lines(found))
    assert "playback_gain.gain_db  -2.00 +/- 0.0" in text
    assert "correlations with all findings" in text and "correlations of the residual" in text
    assert "added, dB  verdict" in text
    left, profile_alone = (independence_lines(test)[3] for test in (found.independence, found.comparison.independence))
    assert "first arrival, changed" in profile_alone and "first arrival, changed" not in left


def test_numbers_say_where_their_error_is_from():
    rows = [
        Known("a", "q", 0, 12.0, "1", 0.3, "jacobian"),
        Known("a", "s", 1, 2.0, "s", 0.1, "thirds"),
        Known("a", "hardness", 0, 100.0, "", None, "at its bound"),
        Known("a", "damping", 0, 0.001, "", 0.01, "jacobian"),
    ]
    assert [error_text(row) for row in rows] == [
        "12.0 +/- 0.300 (2.5 %)",
        "2.00 +/- 0.100 s (5 %), from fits to thirds of the recording",
        "100, at its bound",
        "0.00100 +/- 0.0100 (the error exceeds the number)",
    ]
    lines = precision_lines(Precision(tuple(rows), (("a.q", "a.s[1]", -0.83),)))
    assert lines[-1] == "  a.q, a.s[1]  -0.83"


def test_a_list_of_numbers_is_one_line_of_json(tmp_path):
    data = {"rows": [[1.5, 2, None], ["a]\n[b", "c"]], "objects": [{"x": [1, 2]}], "empty": []}
    write_json(data, tmp_path / "x.json")
    text = (tmp_path / "x.json").read_text()
    assert json.loads(text) == data and "[ 1.5, 2, null ]" in text and '"x": [ 1, 2 ]' in text
