"""Word errors by a recogniser on this machine; nothing is fetched.

Whisper (faster-whisper, int8, one thread): a folder with a CTranslate2 conversion, model.bin, config.json,
tokenizer.json, vocabulary.json or .txt. Transcripts are kept under the sound's hash, so that none is recognised twice.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import jiwer
import numpy as np

from bench.cache import Cache
from edgefilter.errors import UsageError
from edgefilter.types import Samples, as_samples

SETTINGS = {"language": "en", "beam_size": 1, "temperature": 0.0, "condition_on_previous_text": False,
            "without_timestamps": True}  # fmt: skip
PEAK = 0.5
"""Every input is scaled to this peak, so that levels do not count."""
_TEENS = "ten eleven twelve thirteen fourteen fifteen sixteen seventeen eighteen nineteen"
_SMALL = f"zero one two three four five six seven eight nine {_TEENS}".split()
_TENS = "_ _ twenty thirty forty fifty sixty seventy eighty ninety".split()
_ORDINALS = {"one": "first", "two": "second", "three": "third", "five": "fifth", "eight": "eighth", "nine": "ninth",
             "twelve": "twelfth"}  # fmt: skip
_TITLES = {"mr": "mister", "mrs": "missus", "dr": "doctor", "st": "saint"}


@dataclass(frozen=True, slots=True)
class WordErrors:
    """Errors (substitutions, deletions, insertions) against a text of `words` words; how many of them were which."""

    errors: int
    words: int
    deletions: int = 0
    insertions: int = 0

    @property
    def rate(self) -> float:
        """Word error rate, 0 to far above 1 where words were invented or the robot's were recognised."""
        return self.errors / self.words

    @property
    def capped(self) -> float:
        """The rate, at most 1: worse than hearing nothing counts as hearing nothing."""
        return min(self.rate, 1.0)


def word_errors(text: str, recognised: str) -> WordErrors:
    """Levenshtein distance in words after `normalise` of both. Raises UsageError for a text without words."""
    text, recognised = normalise(text), normalise(recognised)
    if not text:
        raise UsageError("the text to compare with has no words, expected what the human says: check the transcript")
    words = len(text.split())
    if not recognised:
        return WordErrors(words, words, deletions=words)
    counts = jiwer.process_words(text, recognised)
    errors = counts.substitutions + counts.deletions + counts.insertions
    return WordErrors(errors, words, counts.deletions, counts.insertions)


def normalise(text: str) -> str:
    """Lower case; integers (1100-1999 as years), ordinals, mr, mrs, dr, st as words; no punctuation but inner apostrophes.

    >>> normalise("Mr. Brown's 3rd dog, born in 1839 -- 21 years!")
    "mister brown's third dog born in eighteen thirty nine twenty one years"
    """
    text = text.lower().replace("\u2019", "'").replace("\u2018", "'")
    text = re.sub(r"(?<=\d),(?=\d{3})", "", text)
    text = re.sub(r"\d+(st|nd|rd|th)?", lambda found: f" {_number(found[0])} ", text)
    text = re.sub(r"[^a-z' ]+", " ", text)
    words = (word.strip("'") for word in text.split())
    return " ".join(_TITLES.get(word, word) for word in words if word)


def _number(found: str) -> str:
    digits = found.rstrip("stndrh")
    words = _spell(int(digits)).split()
    if digits != found:
        last = words[-1]
        words[-1] = _ORDINALS.get(last) or (last[:-1] + "ieth" if last.endswith("y") else last + "th")
    return " ".join(words)


def _spell(n: int) -> str:
    if n < 20:
        return _SMALL[n]
    if n < 100:
        return _TENS[n // 10] + (f" {_SMALL[n % 10]}" if n % 10 else "")
    if 1100 <= n < 2000 and n % 100 >= 10:
        return f"{_spell(n // 100)} {_spell(n % 100)}"
    for unit, name in ((10**9, "billion"), (10**6, "million"), (1000, "thousand"), (100, "hundred")):
        if n >= unit:
            return f"{_spell(n // unit)} {name}" + (f" {_spell(n % unit)}" if n % unit else "")
    raise AssertionError(n)


class Recogniser:
    """Transcribes with the CTranslate2 model in a folder; loads it only for sound that the cache does not know."""

    def __init__(self, folder: Path, cache: Cache) -> None:
        model, config = folder / "model.bin", folder / "config.json"
        if not model.is_file() or not config.is_file():
            wanted = "expected a CTranslate2 conversion of Whisper"
            raise UsageError(f"{folder} holds no model.bin and config.json; {wanted}")
        self.identity = f"{model.stat().st_size} {config.read_text()} {SETTINGS} {PEAK}"
        self._folder, self._cache = folder, cache

    def transcribe(self, samples: Samples) -> str:
        """What the recogniser understands of samples (n,), 16 kHz; silence gives an empty text."""
        samples = as_samples(samples, "samples")
        peak = float(np.abs(samples).max(initial=0.0))
        if peak == 0.0:
            return ""
        samples = samples * np.float32(PEAK / peak)
        return self._cache.get(lambda: self._recognise(samples), self.identity, samples)

    def _recognise(self, samples: Samples) -> str:
        segments, _ = self._model.transcribe(samples, **SETTINGS)
        return " ".join(segment.text.strip() for segment in segments)

    @cached_property
    def _model(self):  # noqa: ANN202
        from faster_whisper import WhisperModel

        return WhisperModel(str(self._folder), device="cpu", compute_type="int8", cpu_threads=1, local_files_only=True)
