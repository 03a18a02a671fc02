"""Downloaded archives of speech.

Whether they are what they should be, and single recordings and transcripts out of them.
"""

from __future__ import annotations

import hashlib
import io
import tarfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import soundfile as sf

from edgefilter.errors import UsageError
from edgefilter.types import SAMPLE_RATE

MD5 = {
    "train-clean-100": "2a93770f6d5c6c964bc36631d331a522",
    "test-clean": "32fa31d27d2e1cad72775fee3f4849a9",
    "test-other": "fb5a50374b501bb3bac4815ee91d3135",
}
"""As published with LibriSpeech (md5sum.txt of OpenSLR 12). OpenSLR 101 publishes none for speechocean762."""
CHUNK = 1 << 20


def archive_name(path: Path) -> str:
    """What an archive is called without its suffixes.

    >>> archive_name(Path("downloads/test-clean.tar.gz"))
    'test-clean'
    """
    return path.name.split(".tar")[0]


def check(path: Path, published: Mapping[str, str] = MD5) -> dict[str, object]:
    """Bytes and sha256 of an archive; raises UsageError where its publisher's MD5 is known and another one."""
    md5, sha256 = hashlib.md5(usedforsecurity=False), hashlib.sha256()
    try:
        with path.open("rb") as file:
            while chunk := file.read(CHUNK):
                md5.update(chunk)
                sha256.update(chunk)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}; expected a downloaded archive") from None
    wanted = published.get(archive_name(path))
    if wanted and md5.hexdigest() != wanted:
        raise UsageError(f"{path} has the MD5 {md5.hexdigest()}, expected {wanted}: download it again")
    return {"files": 1, "bytes": path.stat().st_size, "sha256": sha256.hexdigest()}


def take(archive: Path, wanted: Mapping[str, Path]) -> dict[str, tuple[float, str]]:
    """Write recordings of a tar archive where they are wanted, as FLAC, and return their seconds and texts.

    LibriSpeech keeps texts in SPEAKER-CHAPTER.trans.txt, speechocean762 in files called `text`; both have a name and
    the words in a line. The archive is read once, from its beginning to its end; no path inside it decides where
    anything is written.

    Parameters
    ----------
    archive
        .tar, .tar.gz, ...
    wanted
        The file to write by the recording's name without suffix.

    Raises
    ------
    UsageError
        For what is no tar archive, for a recording that is not 16 kHz mono, and where one or its text is missing.
    """
    seconds: dict[str, float] = {}
    texts: dict[str, str] = {}
    try:
        with tarfile.open(archive, "r|*") as members:
            for member in members:
                place = PurePosixPath(member.name)
                if member.isfile() and place.stem in wanted and place.suffix.lower() in (".flac", ".wav"):
                    seconds[place.stem] = _write(
                        members.extractfile(member).read(), wanted[place.stem], f"{archive}:{place}"
                    )
                elif member.isfile() and (place.name.endswith(".trans.txt") or place.name == "text"):
                    lines = members.extractfile(member).read().decode("utf-8").splitlines()
                    texts |= {
                        name: " ".join(words) for name, *words in map(str.split, filter(None, lines)) if name in wanted
                    }
    except (tarfile.TarError, EOFError) as error:
        raise UsageError(f"{archive} cannot be read as a tar archive ({error}): download it again") from None
    for what, found in (("recordings", seconds), ("texts", texts)):
        if missing := [name for name in wanted if name not in found]:
            raise UsageError(
                f"{archive} lacks {len(missing)} of {len(wanted)} {what}, {missing[0]} first: is it the right archive?"
            )
    return {name: (seconds[name], texts[name].lower()) for name in wanted}


def _write(content: bytes, path: Path, name: str) -> float:
    """Write FLAC; what is FLAC already stays bit for bit. Returns its length in seconds."""
    about = sf.info(io.BytesIO(content))
    if about.samplerate != SAMPLE_RATE or about.channels != 1:
        raise UsageError(
            f"{name} has {about.samplerate} Hz and {about.channels} channels, expected {SAMPLE_RATE} Hz mono"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    if about.format == "FLAC":
        path.write_bytes(content)
    else:
        sf.write(path, sf.read(io.BytesIO(content), dtype="int16")[0], SAMPLE_RATE, subtype="PCM_16")
    return about.frames / SAMPLE_RATE
