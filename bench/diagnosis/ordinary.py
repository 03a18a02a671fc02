"""Ordinary: what each effect explains in recordings in which nothing is missing, and whether the p-values are uniform there.

--cases are folders of controls (bench.simulate.hidden_cases --set controls). With --learn FILE their table is written as
edgefilter/diagnosis/ordinary.json holds it; without, each recording's least p-value over all effects is held against the
uniform distribution (Kolmogorov-Smirnov): learn on some controls, look at others. The table belongs to the code that fits
and scores: learn it anew where that changes.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from scipy.stats import kstest, norm

from bench import provenance, results
from bench.diagnosis.names import find_cases, signals
from bench.metrics import counted
from bench.provenance import DIAGNOSIS
from bench.recordings import CALIBRATION, progress
from edgefilter.calibration.calibrate import calibrate
from edgefilter.diagnosis.ordinary import LEAST_DB, Chance, Ordinary, explained_db, p_value
from edgefilter.diagnosis.prepare import prepare
from edgefilter.echo.effect import vanishes
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.errors import UsageError
from edgefilter.types import Array

UPPER = (0.75, 0.95)
"""Quantiles of what an effect explains that its normal distribution goes through: the tail counts, and above them are ten of
200 recordings."""
ENOUGH = 40
"""Recordings to learn from: above the upper quantile lie two."""
LEVELS = (0.01, 0.05, 0.1, 0.25, 0.5)


def gains(case: Path) -> dict[str, float]:
    """Trial.gain_db of each effect that a search tries, fitted alone; 0 where its fit finds nothing."""
    recorded = signals(case)
    prepared = prepare(calibrate(*map(recorded.get, CALIBRATION)), recorded["mic"], recorded["ref"])
    scorer, model = prepared, prepared.model
    base, found = scorer.of(model), {name: 0.0 for name in names() if not find(name).free}
    for name in found:
        effect = find(name)
        values = model.fitted(name, scorer.measurement)
        if not vanishes(effect, values):
            found[name] = base.level_db - scorer.of(model.with_effect(name, values)).level_db
    return found


def learnt(found: Sequence[Mapping[str, float]]) -> dict[str, object]:
    """The table of edgefilter/diagnosis/ordinary.json from the gains of some recordings.

    The normal distributions are those of the upper quarter, since what is surprising lies there. An effect that helps in few recordings, or in
    none, is taken for an ordinary one: to each is added one recording in which it helps as the median effect does. As
    many effects count as independent as bring the median of the least p-values to one half.
    """
    explained = {name: np.array([explained_db(one[name]) for one in found]) for name in found[0]}
    helps = {name: each[each > LEAST_DB] for name, each in explained.items()}
    own = {name: _middle_and_spread(each) for name, each in helps.items() if each.size > 1}
    typical = np.median(list(own.values()), axis=0)
    effects = {}
    for name, each in helps.items():
        middle, spread = own.get(name, typical)
        weights = each.size * (name in own), 1
        effects[name] = {
            "share": round((each.size + 1) / (len(found) + 2), 4),
            "middle_db": round(float(np.average([middle, typical[0]], weights=weights)), 2),
            "spread_db": round(float(np.sqrt(np.average([spread**2, typical[1] ** 2], weights=weights))), 2),
        }
    chances = Ordinary({name: Chance(**of) for name, of in effects.items()})
    middle = float(np.median(least(chances.p_value, found)))
    return {"recordings": len(found), "independent": round(np.log(2.0) / -np.log1p(-middle), 3), "effects": effects}


def least(p_value: Callable[[str, float], float], found: Sequence[Mapping[str, float]]) -> Array:
    """The least p-value of each recording over all effects, (n,)."""
    return np.array([min(p_value(name, gain) for name, gain in one.items()) for one in found])


def _middle_and_spread(explained: Array) -> tuple[float, float]:
    """Mean and standard deviation of the normal distribution that goes through two upper quantiles of values (n,)."""
    heights = np.quantile(explained, UPPER)
    spread = float(np.diff(heights)[0] / np.diff(norm.ppf(UPPER))[0])
    return float(heights[0] - spread * norm.ppf(UPPER[0])), spread


def run(options: argparse.Namespace) -> str:
    made_with = provenance.stamp({"CASES": options.cases}, [DIAGNOSIS])
    cases = [case for folder in options.cases for case in find_cases(folder, options.limit)]
    if options.learn and len(cases) < ENOUGH:
        raise UsageError(f"found {len(cases)} recordings to learn from, expected {ENOUGH} or more")
    with ProcessPoolExecutor(options.jobs) as pool:
        measured = pool.map(gains, cases)
        found = [next(measured) for _ in progress(cases, "case", "ordinary")]
    if options.learn:
        options.learn.write_text(json.dumps(learnt(found), indent=1) + "\n", encoding="utf-8")
        return str(options.learn)
    p_values = least(p_value, found)
    test = kstest(p_values, "uniform")
    text = (
        f"The least p-value of each of {p_values.size} recordings, over all effects; of uniform ones as many are below any"
        f" limit as it says. Kolmogorov-Smirnov: largest distance {test.statistic:.3f}, p = {test.pvalue:.2g}."
    )
    columns = ["p-value below", "recordings"]
    table = results.table("ordinary", "Nothing is missing: p-values", columns, _rows(p_values), text)
    values = [{"case": case.name, "gains_db": one} for case, one in zip(cases, found, strict=True)]
    return results.write(options.output, "ordinary", "Chance", made_with, [table], cases={"controls": values})


def _rows(p_values: Array) -> list[list[str]]:
    rows = []
    for level in LEVELS:
        found = counted((p_values < level).tolist())
        share = f"{found['mean']:.1f} % [{found['low']:.1f}, {found['high']:.1f}]"
        rows.append([f"{level:g}", f"{found['hits']} of {found['n']}, {share}"])
    return rows
