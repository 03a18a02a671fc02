"""Damage to real files: random bytes anywhere, and, inside an archive of arrays, random values with sound checksums."""

from __future__ import annotations

import io
import json
import random
import warnings
import zipfile

import numpy as np

NUMBERS = (
    0,
    1,
    -1,
    0.5,
    1e-300,
    1e300,
    -1e300,
    2**31,
    2**63,
    -(2**63),
    10**400,
    float("nan"),
    float("inf"),
    16000,
    601,
)
VALUES = (*NUMBERS, "", "\0", "x" * 5000, "../../etc/passwd", None, True, [], {}, [[[]]], {"array": "response"})
WORDS = (b"\0" * 4, b"\xff" * 4, b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0\0\xc0\x7f", b"\x80" * 9 + b"\x01", b"{", b"]")


def damaged(data: bytes, rng: random.Random) -> bytes:
    """The bytes with 1 to 8 changes: bits turned, words put in, pieces cut out, doubled or moved, the end cut off."""
    content = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 8))):
        if not content:
            break
        # half of the changes hit the first 256 bytes, where headers are
        at = rng.randrange(min(len(content), 256) if rng.random() < 0.5 else len(content))
        size = rng.choice((1, 2, 4, 16, 64, 1000))
        kind = rng.randrange(7)
        if kind == 0:
            content[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            content[at] = rng.randrange(256)
        elif kind == 2:
            word = rng.choice(WORDS)
            content[at : at + len(word)] = word
        elif kind == 3:
            del content[at : at + size]
        elif kind == 4:
            content[at:at] = content[at : at + size]
        elif kind == 5:
            there = rng.randrange(len(content))
            content[there : there + size] = content[at : at + size]
        else:
            del content[at + 1 :]
    return bytes(content)


def damaged_json(text: bytes, rng: random.Random) -> bytes:
    """JSON text in which a value somewhere is another, a key is gone or new; sometimes damaged as bytes."""
    if rng.random() < 0.2:
        return damaged(text, rng)
    whole = json.loads(text)
    places = list(_places(whole))
    for _ in range(rng.choice((1, 1, 2, 5))):
        inside, key = rng.choice(places)
        deed = rng.randrange(8)
        if isinstance(inside, dict) and deed == 0:
            inside.pop(key, None)
        elif isinstance(inside, dict) and deed == 1:
            inside[rng.choice(("surprise", "values", "array", ""))] = rng.choice(VALUES)
        elif key in inside if isinstance(inside, dict) else key < len(inside):
            inside[key] = _changed(inside[key], rng)
    return json.dumps(whole).encode()


def _places(value: object) -> list[tuple[object, object]]:
    """Every (container, key) in a JSON value."""
    keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
    return [(value, key) for key in keys] + [place for key in keys for place in _places(value[key])]


def _changed(value: object, rng: random.Random) -> object:
    if isinstance(value, int | float) and abs(value) < 2**63 and not isinstance(value, bool) and rng.random() < 0.5:
        return rng.choice((value * rng.uniform(-3, 3), value + rng.choice((-1, 1)), value * 10.0 ** rng.randint(-9, 9)))
    return rng.choice(VALUES)


def damaged_archive(data: bytes, rng: random.Random) -> bytes:
    """An .npz of which one or two members are other arrays, other JSON or other bytes, packed so that its checksums agree."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    for _ in range(rng.choice((1, 1, 2))):
        at = rng.randrange(len(members))
        name, content = members[at]
        kind = rng.randrange(10)
        if kind == 0:
            members[at] = (name, damaged(content, rng))
        elif kind == 1:
            members.append((rng.choice((name, "more.npy", "effect_0_0.npy", "../x.npy")), content))
        elif kind == 2:
            members[at] = (name, members[rng.randrange(len(members))][1])
        else:
            try:
                array = np.load(io.BytesIO(content), allow_pickle=False)
            except Exception:  # it was damaged by the change before
                continue
            members[at] = (name, _packed(_other(name, array, rng)))
    packed = io.BytesIO()
    with zipfile.ZipFile(
        packed, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))
    ) as archive:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that a name comes twice is meant
            for name, content in members:
                archive.writestr(zipfile.ZipInfo(name), content)
    return packed.getvalue()


def _packed(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def _other(name: str, array: np.ndarray, rng: random.Random) -> np.ndarray:
    """Another array in place of this one: other values, shape, type; of the header, other JSON."""
    if name == "header.npy" and array.dtype == np.uint8 and array.ndim == 1 and array.size:
        try:
            return np.frombuffer(damaged_json(array.tobytes(), rng), np.uint8)
        except (ValueError, IndexError):  # it was damaged before
            return array[: rng.randrange(array.size)]
    kind = rng.randrange(6)
    if kind == 0 and array.dtype.kind != "c":
        with np.errstate(all="ignore"):
            return array.astype(rng.choice(("<f8", "<f4", "<f2", "<i8", "|u1", "|b1", "<c8")))
    if kind == 1:
        return array.reshape(-1)[: rng.randrange(array.size + 1)]
    if kind == 2:
        return np.resize(array, rng.choice(((0,), (1,), (601,), (2, 601), (128,), (70000,), (5, 5, 5))))
    changed = np.array(array, ndmin=1)
    if not changed.size or changed.dtype.kind not in "fiu":
        return changed
    with np.errstate(all="ignore"):
        if kind == 3 or array.dtype.itemsize == 1:
            changed = (changed * 10.0 ** rng.randint(-40, 40)).astype(array.dtype)
        else:
            places = [rng.randrange(changed.size) for _ in range(rng.choice((1, 3, 100)))]
            value = rng.choice([number for number in NUMBERS if abs(number) < 2**31 or number != number])
            if array.dtype.kind != "f":
                value = 7
            changed.reshape(-1)[places] = value
    return changed.reshape(array.shape)
