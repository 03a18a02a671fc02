"""Word errors by a recogniser on this machine; nothing is fetched.

Whisper-base (faster-whisper, int8, one thread): a folder with a CTranslate2 conversion, model.bin, config.json,
tokenizer.json, vocabulary.json. PocketSphinx: the American English that its package brings along, Gaussian mixtures and
trigrams, which err otherwise than a network does. Transcripts are kept in a JSON-lines file under the audio's hash, so
that no audio is recognised twice.
"""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path

import jiwer
import numpy as np

from edgefilter.errors import UsageError
from edgefilter.types import Samples, as_samples

SETTINGS = {
    "language": "en",
    "beam_size": 1,
    "temperature": 0.0,
    "condition_on_previous_text": False,
    "without_timestamps": True,
}
SPHINX = "pocketsphinx"
SPHINX_SETTINGS = {"cmn": "batch", "fwdflat": False, "maxhmmpf": 5000, "maxwpf": 20}
"""Each utterance's mean by itself, so that their order changes nothing; one pass through a narrower beam, which on speech
of validation speakers takes a third of the time and errs as often (60 and 60 % of 420 words, 83 and 85 with noise)."""
PEAK = 0.5
"""Every input is scaled to this peak, so that the recogniser does not judge levels."""
_TEENS = "ten eleven twelve thirteen fourteen fifteen sixteen seventeen eighteen nineteen"
_SMALL = f"zero one two three four five six seven eight nine {_TEENS}".split()
_TENS = "_ _ twenty thirty forty fifty sixty seventy eighty ninety".split()
_ORDINALS = {
    "one": "first",
    "two": "second",
    "three": "third",
    "five": "fifth",
    "eight": "eighth",
    "nine": "ninth",
    "twelve": "twelfth",
}
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
    if not recognised:
        return WordErrors(len(text.split()), len(text.split()), deletions=len(text.split()))
    counts = jiwer.process_words(text, recognised)
    errors = counts.substitutions + counts.deletions + counts.insertions
    return WordErrors(errors, len(text.split()), counts.deletions, counts.insertions)


def normalise(text: str) -> str:
    """Lower case; integers and ordinals as words (1100-1999 read as years).

    Mr, mrs, dr, st spelt out; of the punctuation only apostrophes inside words stay. British and American spellings are
    left alone (both are in the recordings).

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


def find_model(name: str) -> tuple[str, Path]:
    """Name and folder of the model at that path, of "pocketsphinx", or of a model of faster-whisper that was downloaded before ("tiny.en").

    Fetches nothing. Raises UsageError where there is none.
    """
    if Path(name).is_dir():
        return Path(name).name, Path(name)
    if name == SPHINX:
        return name, _sphinx_model()
    try:
        from faster_whisper.utils import download_model

        return name, Path(download_model(name, local_files_only=True))
    except (ImportError, ValueError, OSError) as error:
        raise UsageError(
            f"{name} is no folder, not {SPHINX}, and no model of faster-whisper that was downloaded before: give a"
            " folder with model.bin and config.json"
        ) from error


def _sphinx_model() -> Path:
    try:
        from pocketsphinx import get_model_path
    except ImportError as error:
        raise UsageError(f"{SPHINX} is not installed: pip install {SPHINX}") from error
    return Path(get_model_path())


class Recogniser:
    """Transcribes with the model in a folder; loads it only for audio that the cache does not know.

    folder: of a CTranslate2 model, or PocketSphinx's. cache: a JSON-lines file of {"key", "text"}, made where missing,
    appended to at once. Raises UsageError where the folder holds no model.
    """

    def __init__(self, folder: Path, cache: Path) -> None:
        loads = _Sphinx if (folder / _Sphinx.ACOUSTIC / "mdef").is_file() else _Whisper
        self._identity = hashlib.sha256(loads.identity(folder).encode()).hexdigest()
        self._load, self._cache = partial(loads, folder), cache
        self._model: _Sphinx | _Whisper | None = None
        cache.parent.mkdir(parents=True, exist_ok=True)
        lines = cache.read_text(encoding="utf-8").splitlines() if cache.exists() else []
        self._known = {entry["key"]: entry["text"] for entry in map(_entry, lines) if entry}

    def transcribe(self, samples: Samples) -> str:
        """What the recogniser hears in samples (n,), 16 kHz; silence gives an empty text."""
        samples = as_samples(samples, "samples")
        peak = float(np.abs(samples).max(initial=0.0))
        if peak == 0.0:
            return ""
        samples = samples * np.float32(PEAK / peak)
        key = hashlib.sha256(self._identity.encode() + samples.tobytes()).hexdigest()
        if key not in self._known:
            self._known[key] = self._recognise(samples)
            with self._cache.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps({"key": key, "text": self._known[key]}) + "\n")
        return self._known[key]

    def _recognise(self, samples: Samples) -> str:
        if self._model is None:
            self._model = self._load()
        return self._model.recognise(samples)


class _Whisper:
    def __init__(self, folder: Path) -> None:
        from faster_whisper import WhisperModel

        self._model = WhisperModel(str(folder), device="cpu", compute_type="int8", cpu_threads=1, local_files_only=True)

    @staticmethod
    def identity(folder: Path) -> str:
        """What the transcripts depend on."""
        config = folder / "config.json"
        if not (folder / "model.bin").is_file() or not config.is_file():
            raise UsageError(
                f"{folder} holds no model.bin and config.json; expected a CTranslate2 conversion of Whisper-base"
            )
        return f"{(folder / 'model.bin').stat().st_size} {config.read_text()} {SETTINGS} {PEAK}"

    def recognise(self, samples: Samples) -> str:
        segments, _ = self._model.transcribe(samples, **SETTINGS)
        return " ".join(segment.text.strip() for segment in segments)


class _Sphinx:
    ACOUSTIC = Path("en-us") / "en-us"

    def __init__(self, folder: Path) -> None:
        from pocketsphinx import Decoder

        language = folder / self.ACOUSTIC.parent
        self._decoder = Decoder(
            hmm=str(folder / self.ACOUSTIC),
            lm=str(language / "en-us.lm.bin"),
            dict=str(language / "cmudict-en-us.dict"),
            loglevel="FATAL",
            **SPHINX_SETTINGS,
        )

    @staticmethod
    def identity(folder: Path) -> str:
        """What the transcripts depend on."""
        return f"{SPHINX} {metadata.version(SPHINX)} {SPHINX_SETTINGS} {PEAK}"

    def recognise(self, samples: Samples) -> str:
        self._decoder.start_utt()
        self._decoder.process_raw((samples * 32767).astype(np.int16).tobytes(), full_utt=True)
        self._decoder.end_utt()
        found = self._decoder.hyp()
        return found.hypstr if found else ""


def _entry(line: str) -> dict | None:
    """A cache line, or None for the last one of a run that was cut off while writing."""
    try:
        return json.loads(line)
    except json.JSONDecodeError:
        return None
