"""What a recording has and no listed effect explains, as an effect of the user's own: a Python file with the family's fitted law."""

from __future__ import annotations

from pathlib import Path

from edgefilter.diagnosis.prepare import prepare
from edgefilter.diagnosis.result import Diagnosis
from edgefilter.diagnosis.score import Judge
from edgefilter.diagnosis.trials import beside
from edgefilter.echo.effects.catalogue import find, names
from edgefilter.echo.measurement import Values
from edgefilter.errors import EdgefilterError, UsageError
from edgefilter.profile.data import Profile
from edgefilter.types import SAMPLE_RATE, Samples

MEMORY = SAMPLE_RATE
"""Samples of the past that the written law is given on a stream: what a slow release remembers."""
HEADER = '''"""{file}: {title}, as `edgefilter diagnose` found it: {sentence}."""

import numpy as np
from scipy import signal

from edgefilter import Effect, Parameter

{code}


class {name_of_class}(Effect):
    """{title}: with amount 1 the law above, with 0 the voice as it is."""

    name = "{name}"
    stage = "{stage}"
    memory = {memory}
    parameters = (Parameter("amount", "1", 0.0, 0.0, 2.0),)

    def apply(self, x, values, sample_rate):
        return (x + values["amount"] * (law(x, sample_rate) - x)).astype(np.float32)

    def fit(self, measurement, model):
        x = measurement.reference
        plain = model.predict(x)
        changed = {changed}
        change, left = (measurement.whiten(s.astype(np.float32)) for s in (changed - plain, measurement.recording - plain))
        used = measurement.weights * change
        return {{"amount": float(np.clip(np.sum(used * left) / (np.sum(used * change) + 1e-30), 0.0, 2.0))}}
'''


def write_effect(path: str | Path, profile: Profile, found: Diagnosis, recording: Samples, reference: Samples) -> str:
    """Write the free law that a diagnosis names, or else the one that explains most by itself, as an effect of the user's own.

    Parameters
    ----------
    path : str or Path
        A Python file to write; its name is the effect's.
    profile, recording, reference
        What was diagnosed, at 16 kHz.
    found : Diagnosis
        What came of it.

    Returns
    -------
    str
        What was written, in a sentence.

    Raises
    ------
    UsageError
        Where the file's name cannot be an effect's.
    EdgefilterError
        Where no such law explains anything, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix != ".py" or not path.stem.isidentifier() or path.stem in names():
        raise UsageError(
            f"{path}: expected the name of a Python file whose stem is one word and no known effect's, such as mine.py"
        )
    name, values = _law(profile, found, recording, reference)
    effect = find(name)
    sentence = effect.sentence(values)
    text = HEADER.format(
        file=path.name,
        title=effect.title.removeprefix("a ").capitalize(),
        sentence=sentence,
        code=effect.code(values),
        name_of_class=path.stem.title().replace("_", ""),
        name=path.stem,
        stage=effect.stage,
        memory=0 if effect.memory == 0 else MEMORY,
        changed="model.predict(law(x, 16000).astype(np.float32))" if effect.stage == "source" else "law(plain, 16000)",
    )
    if "signal." not in effect.code(values):
        text = text.replace("from scipy import signal\n\n", "")
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise EdgefilterError(f"{path}: the effect cannot be written ({error.strerror})") from None
    return sentence


def _law(profile: Profile, found: Diagnosis, recording: Samples, reference: Samples) -> tuple[str, Values]:
    """Name and values of the free law that was found, or else of the one that explains most of what the profile leaves."""
    free = [name for name in names() if find(name).free_law]
    for finding in found.ranking:
        if finding.effect in free:
            return finding.effect, finding.values
    prepared = prepare(profile, recording, reference)
    judge = Judge(prepared)
    trials = [trial for name in free if (trial := beside(judge, name, prepared.model)) is not None]
    best = max(trials, key=lambda trial: trial.gain_db, default=None)
    if best is None or best.gain_db < find(best.name).least_gain_db:
        raise EdgefilterError(
            "no curve, no gain by level and no gain by time explains anything of what the profile leaves: no effect is written"
        )
    return best.name, best.values
