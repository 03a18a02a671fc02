"""Arrays and a JSON header in one .npz: written atomically, read without trusting a byte of it."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import secrets
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, NoReturn, TypeVar

import numpy as np

from edgefilter.errors import ProfileError

FORMAT_VERSION = 1
MAX_FILE_BYTES = 32 * 2**20
MAX_MEMBERS = 256
REMEDY = "give a profile written by 'edgefilter calibrate', or calibrate again"

Effects = tuple[tuple[str, Mapping[str, Any]], ...]
Part = TypeVar("Part", bound="ProfilePart")


@dataclass(frozen=True, eq=False)
class ProfilePart:
    """What a profile may hold beside the rest: arrays, in the file all or none of them, their names behind PREFIX."""

    PREFIX: ClassVar[str]

    def arrays(self) -> dict[str, np.ndarray]:
        """Its arrays by their names in a profile's file."""
        return {self.PREFIX + field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def taken_from(cls: type[Part], arrays: dict[str, Any]) -> Part | None:
        """Take its own out of the arrays of a profile's file; None where there are none, ProfileError where some lack."""
        names = [field.name for field in fields(cls)]
        found = {name: arrays.pop(cls.PREFIX + name) for name in names if cls.PREFIX + name in arrays}
        if found and len(found) < len(names):
            missing = ", ".join(cls.PREFIX + name for name in names if name not in found)
            raise ProfileError(f"array fields missing: {missing}; {REMEDY}")
        return cls(**found) if found else None

    def _check(self, name: str, shape: tuple[int, ...], dtype: type, most: float) -> None:
        """As check_array, for values of -most to most."""
        check_array(self.PREFIX + name, np.asarray(getattr(self, name)), shape, dtype, -most, most)


def refuse(name: str, found: object, expected: str) -> NoReturn:
    """Raise ProfileError for a field."""
    raise ProfileError(f"{name} is {str(found)[:80]}, expected {expected}; {REMEDY}")


def check_array(name: str, array: np.ndarray, shape: tuple[int, ...], dtype: type, low: float, high: float) -> None:
    """Raise ProfileError where the array has another shape or type, is not finite or not within low to high."""
    if array.shape != shape or array.dtype != dtype:
        refuse(name, described(array), f"{np.dtype(dtype)} of shape {shape}")
    wrong = ~((array >= low) & (array <= high))
    if wrong.any():
        at = int(np.argmax(wrong))
        refuse(name, f"{array.ravel()[at]:g} at position {at}", f"{low:g} to {high:g}")


def described(array: np.ndarray) -> str:
    """Its type and shape."""
    return f"{array.dtype} of shape {array.shape}"


def write_fields(path: Path, arrays: Mapping[str, np.ndarray], header: Mapping[str, Any], effects: Effects) -> None:
    """Write arrays, a header of JSON values and the effects to path, whole or not at all; ProfileError where that fails."""
    members = dict(arrays)
    listed = []
    for i, (name, values) in enumerate(effects):
        entry: dict[str, Any] = {"name": name, "values": {}}
        for key, value in values.items():
            where = f"the profile cannot be stored: effects[{i}].{key} is"
            if isinstance(value, np.ndarray) and value.ndim:
                if value.dtype.kind not in "fiub" or not np.isfinite(value).all():
                    raise ProfileError(f"{where} not an array of finite real numbers")
                member = f"effect_{i}_{len(entry['values'])}"
                members[member] = value
                entry["values"][key] = {"array": member}
            elif isinstance(value, bool | int | float | np.generic | np.ndarray):
                entry["values"][key] = value.item() if isinstance(value, np.generic | np.ndarray) else value
            else:
                raise ProfileError(f"{where} {type(value).__name__}, expected a number or an array")
        listed.append(entry)
    try:
        text = json.dumps({**header, "effects": listed}, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ProfileError(f"the profile cannot be stored: {error}; expected finite numbers and arrays") from None
    members["header"] = np.frombuffer(text.encode(), np.uint8)
    members["version"] = np.array(FORMAT_VERSION, np.int64)
    _replace(path, members)


def _replace(path: Path, members: Mapping[str, Any]) -> None:
    """Write to a temporary file beside path, force it to the disk, then rename it over path."""
    path = path.resolve()
    if path.exists() and not path.is_file():
        raise ProfileError(f"{path}: not a file that can be replaced; name a .npz file for the profile")
    temporary = path.with_name(f".{path.name[:32]}.{secrets.token_hex(8)}")
    try:
        # not tempfile: its files are the owner's alone, and the umask that others have can only be read by changing it
        with open(temporary, "xb") as file:
            # numbers alone: nothing is pickled (numpy before 2.1 knows no allow_pickle)
            np.savez_compressed(file, **members)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        raise ProfileError(
            f"{path}: the profile cannot be written ({error.strerror}); choose another place or free space"
        ) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def read_fields(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any], Effects]:
    """(arrays, header, effects) of a file that write_fields wrote; ProfileError, in one line, for any other."""
    try:
        if path.exists() and not path.is_file():  # a pipe would be waited for, without end
            found = "a folder" if path.is_dir() else "no regular file"
            raise ProfileError(f"{path}: is {found}, expected a profile file; {REMEDY}")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise ProfileError(f"{path}: {path.stat().st_size} bytes long, expected at most {MAX_FILE_BYTES}; {REMEDY}")
        return _decode(_members(path.read_bytes()))
    except FileNotFoundError:
        raise ProfileError(f"{path}: no such file; {REMEDY}") from None
    except OSError as error:
        raise ProfileError(f"{path}: cannot be read ({error.strerror}); check the path and its permissions") from None
    except _Damaged as error:
        raise ProfileError(f"{path}: {error}; {REMEDY}") from None


class _Damaged(Exception):
    """What is wrong inside the file, without its name and the remedy."""


def _members(content: bytes) -> dict[str, np.ndarray]:
    """All arrays of an .npz, sizes checked before anything is unpacked, nothing unpickled."""
    if not content.startswith(b"PK\x03\x04"):
        raise _Damaged(f"not a profile: starts with {content[:4]!r}, expected the zip archive of an .npz")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            total = sum(info.file_size for info in infos)
            if len(infos) > MAX_MEMBERS or total > MAX_FILE_BYTES:
                most = f"expected at most {MAX_FILE_BYTES} in {MAX_MEMBERS}"
                raise _Damaged(f"unpacks to {total} bytes in {len(infos)} members, {most}")
            arrays = {}
            for info in infos:
                if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
                    raise _Damaged(f"member {info.filename!r} is packed in a way that profiles are not")
                with archive.open(info) as member:
                    arrays[info.filename.removesuffix(".npy")] = _array(member.read(info.file_size + 1), info.filename)
            return arrays
    except _Damaged:
        raise
    except Exception as error:  # zipfile lets through what its arithmetic raises: ValueError, struct.error, zlib.error
        raise _Damaged(f"truncated or damaged ({' '.join(str(error).split())[:80]})") from None


def _array(content: bytes, name: str) -> np.ndarray:
    """One .npy array from its bytes; the shape must account for exactly the bytes that are there."""
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        if version != (1, 0):
            raise _Damaged(f"member {name!r} is in .npy format {version}, expected (1, 0)")
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of headers that numpy mends, which nobody wrote here
            shape, fortran, dtype = np.lib.format.read_array_header_1_0(file)
    except Exception as error:  # numpy lets through what Python's own parser raises: TokenError, RecursionError
        raise _Damaged(f"member {name!r} is no .npy array ({' '.join(str(error).split())[:80]})") from None
    if dtype.hasobject or dtype.kind not in "fiub":
        raise _Damaged(f"member {name!r} holds {dtype} (pickled objects or text), expected numbers")
    if any(type(size) is not int or size < 0 for size in shape):
        raise _Damaged(f"member {name!r} claims shape {shape}, expected sizes from 0 up")
    body = content[file.tell() :]
    if math.prod(shape) * dtype.itemsize != len(body):
        raise _Damaged(f"member {name!r} claims shape {shape} of {dtype} but holds {len(body)} bytes")
    return np.frombuffer(body, dtype).reshape(shape, order="F" if fortran else "C")


def _decode(members: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, Any], Effects]:
    version = members.pop("version", None)
    if version is None or version.shape != () or version.dtype.kind != "i":
        raise _Damaged("field version is missing, so this is no profile")
    if int(version) != FORMAT_VERSION:
        raise _Damaged(f"version is {int(version)}, expected {FORMAT_VERSION}: made by another release of edgefilter")
    text = members.pop("header", None)
    if text is None or text.dtype != np.uint8 or text.ndim != 1:
        raise _Damaged("field header is missing")
    try:
        header = json.loads(bytes(text).decode(), parse_constant=int)  # which refuses NaN and Infinity
    except (ValueError, RecursionError):
        raise _Damaged("field header is not JSON text") from None
    if not isinstance(header, dict):
        raise _Damaged(f"field header is a JSON {type(header).__name__}, expected an object")
    effects = _effects(header.pop("effects", None), members)
    return {name: value for name, value in members.items() if not name.startswith("effect_")}, header, effects


def _effects(listed: object, members: Mapping[str, np.ndarray]) -> Effects:
    """The effects from the header's list, arrays put in their places."""
    if not isinstance(listed, list) or not all(isinstance(entry, dict) for entry in listed):
        raise _Damaged("field effects is not a list of effects")
    effects = []
    for i, entry in enumerate(listed):
        name, values = entry.get("name"), entry.get("values")
        if not isinstance(name, str) or not isinstance(values, dict):
            raise _Damaged(f"effects[{i}] has no name or no values")
        where = f"effects[{i}] ({name[:40]})"
        effects.append((name, {key: _value(value, f"{where}.{key[:40]}", members) for key, value in values.items()}))
    return tuple(effects)


def _value(value: object, where: str, members: Mapping[str, np.ndarray]) -> object:
    if isinstance(value, dict):
        array = members.get(str(value.get("array")))
        if array is None:
            raise _Damaged(f"{where} refers to an array that is not in the file")
        if not np.isfinite(array).all():
            raise _Damaged(f"{where} is not finite, expected finite values")
        return array
    if isinstance(value, bool | int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise _Damaged(f"{where} is {type(value).__name__} {str(value)[:20]!r}, expected a finite number or an array")
