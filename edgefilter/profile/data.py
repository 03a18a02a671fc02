"""The profile: what calibration measured of one robot in one place, in one versioned file that holds no code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgefilter.dsp.psd import GRID_BINS, GRID_FFT
from edgefilter.dsp.stft import StftConfig
from edgefilter.echo.effect import complete
from edgefilter.echo.effects.catalogue import find
from edgefilter.echo.effects.catalogue import names as known_effects
from edgefilter.echo.model import EchoModel
from edgefilter.errors import ProfileError, printable
from edgefilter.profile.approximation import LinearApproximation
from edgefilter.profile.array import ArrayCalibration
from edgefilter.profile.file import REMEDY, Effects, check_array, read_fields, refuse, write_fields
from edgefilter.profile.while_moving import WhileMoving
from edgefilter.types import PRE_ROLL, SAMPLE_RATE, Array, Samples

GRID_HZ = np.arange(GRID_BINS) * SAMPLE_RATE / GRID_FFT
"""(601,) Hz, 0 to 8000 in steps of 13.33."""
DISTORTION_ORDERS = (2, 3, 4, 5)
LOW_SNR_DB = 10.0
"""Signal-to-noise ratio below which a band's path is wrong by more than 3 dB at times."""
MAX_TAPS = 4 * SAMPLE_RATE
"""Samples, 4 s: longer than the reverberation of any room that a robot talks in, and than the lag of any player."""
LEARNED = "what the running filter learned"
PROVISIONAL = "made from the recording itself: what is stationary and linear is taken for the robot"
"""Sources of profiles that were made without a calibration: their paths are only as accurate as speech allows, less than by a sweep."""

_ARRAYS = ("response", "noise_psd", "band_hz", "band_snr_db", "distortion_db")


@dataclass(frozen=True, eq=False)
class Profile:
    """The robot's own voice at its microphone, as calibrated; checked on construction, so on load as well.

    Parameters
    ----------
    echo : EchoModel
        The path from reference to microphone, its impulse response starting PRE_ROLL samples before the direct sound,
        and the effects.
    delay : float
        Index of the direct sound in the calibration recording, samples.
    response : ndarray of float32, shape (601,)
        The paper's |H_m(f) H_s(f)|, eq. (3)-(5), on GRID_HZ.
    noise_psd : ndarray of float32, shape (601,)
        One-sided power spectral density of the fan, full scale^2/Hz, on GRID_HZ.
    band_hz : ndarray of float64, shape (B, 2)
        Edges of the third-octave bands, Hz.
    band_snr_db : ndarray of float64, shape (B,)
        The sweep's coherent part over the fan in each band, dB.
    distortion_db : ndarray of float64, shape (4,)
        Harmonic distortion of orders 2 to 5 over the linear response, dB (Farina 2000).
    sample_rate : int
        16000.
    warnings : tuple of str
        Why and in which bands the calibration is not to be trusted.
    created, source : str
        ISO date, and what it was made from.
    approximation : LinearApproximation, optional
        What a linear path leaves of the robot at several levels, where it was calibrated with multisines.
    array : ArrayCalibration, optional
        The further microphones, where it was calibrated with several; all else is of the first one.
    while_moving : WhileMoving, optional
        What sounds with the voice, where the calibration has heard the robot talk and move.

    Raises
    ------
    ProfileError
        Where a field has the wrong shape or type, is not finite or out of range.

    Examples
    --------
    >>> flat, path = np.ones(601, np.float32), np.zeros(6400, np.float32)
    >>> path[PRE_ROLL] = 0.5
    >>> bands = np.array([[900.0, 1100.0]])
    >>> profile = Profile(EchoModel(path), 300.0, flat / 2, flat * 1e-9, bands, np.array([40.0]), np.full(4, -50.0))
    >>> round(float(profile.echo.predict(np.eye(1, 1000, dtype=np.float32)[0])[PRE_ROLL]), 3)
    0.5
    """

    echo: EchoModel
    delay: float
    response: Samples
    noise_psd: Samples
    band_hz: Array
    band_snr_db: Array
    distortion_db: Array
    sample_rate: int = SAMPLE_RATE
    warnings: tuple[str, ...] = ()
    created: str = ""
    source: str = ""
    approximation: LinearApproximation | None = None
    array: ArrayCalibration | None = None
    while_moving: WhileMoving | None = None

    def __post_init__(self) -> None:
        arrays = self._arrays()
        taps, bands = arrays["impulse_response"].shape, arrays["band_snr_db"].shape
        if len(taps) != 1 or not 2 * PRE_ROLL <= taps[0] <= MAX_TAPS:
            refuse("impulse_response", f"of shape {taps}", f"({2 * PRE_ROLL} to {MAX_TAPS},)")
        if len(bands) != 1 or bands[0] > 100:
            refuse("band_snr_db", f"of shape {bands}", "(number of bands,)")
        check_array("impulse_response", arrays["impulse_response"], taps, np.float32, -1e3, 1e3)
        check_array("response", arrays["response"], (GRID_BINS,), np.float32, 0.0, 1e6)
        check_array("noise_psd", arrays["noise_psd"], (GRID_BINS,), np.float32, 0.0, 1.0)
        check_array("band_hz", arrays["band_hz"], (*bands, 2), np.float64, 0.0, SAMPLE_RATE / 2)
        check_array("band_snr_db", arrays["band_snr_db"], bands, np.float64, -300.0, 300.0)
        orders = (len(DISTORTION_ORDERS),)
        check_array("distortion_db", arrays["distortion_db"], orders, np.float64, -300.0, 300.0)
        if isinstance(self.sample_rate, bool) or self.sample_rate != SAMPLE_RATE:
            refuse("sample_rate", repr(self.sample_rate), f"{SAMPLE_RATE} Hz")
        delay = self.delay
        if isinstance(delay, bool) or not (isinstance(delay, int | float | np.number) and abs(delay) <= MAX_TAPS):
            refuse("delay", repr(delay), f"-{MAX_TAPS} to {MAX_TAPS} samples")
        for name in ("created", "source"):
            if not isinstance(getattr(self, name), str):
                refuse(name, type(getattr(self, name)).__name__, "a text")
        if not all(isinstance(text, str) for text in self.warnings):
            refuse("warnings", "not all texts", "texts")

    def _arrays(self) -> dict[str, np.ndarray]:
        """All that every profile has, by their names in its file."""
        arrays = {name: np.asarray(getattr(self, name)) for name in _ARRAYS}
        return arrays | {"impulse_response": np.asarray(self.echo.impulse_response)}

    def save(self, path: str | Path) -> None:
        """Write one .npz atomically: the file at path is the old one or the whole new one, also on a full disk.

        Parameters
        ----------
        path : str or Path
            Where to; arrays and JSON, no code.

        Raises
        ------
        ProfileError
            Where it cannot be written.
        """
        arrays = self._arrays()
        for part in (self.approximation, self.array, self.while_moving):
            arrays |= part.arrays() if part else {}
        header = {
            "pre_roll": PRE_ROLL,
            "delay": float(self.delay),
            "sample_rate": int(self.sample_rate),
            "warnings": list(self.warnings),
            "created": self.created,
            "source": self.source,
        }
        write_fields(Path(path), arrays, header, self.echo.effects)

    @classmethod
    def load(cls, path: str | Path) -> Profile:
        """Read a profile that `save` wrote.

        Parameters
        ----------
        path : str or Path
            The .npz.

        Returns
        -------
        Profile
            Checked field by field.

        Raises
        ------
        ProfileError
            For any other file, in one line.
        """
        arrays, header, effects = read_fields(Path(path))
        try:
            parts: dict[str, Any] = {
                "approximation": LinearApproximation.taken_from(arrays),
                "array": ArrayCalibration.taken_from(arrays),
                "while_moving": WhileMoving.taken_from(arrays),
            }
            known = {"pre_roll", "delay", "sample_rate", "warnings", "created", "source"}
            for kind, found, names in (("array", arrays, {*_ARRAYS, "impulse_response"}), ("header", header, known)):
                if set(found) != names:
                    odd = ", ".join(sorted(names - set(found))) or "nothing"
                    extra = ", ".join(sorted(name[:40] for name in set(found) - names)) or "nothing"
                    raise ProfileError(f"{kind} fields missing: {odd}; unknown: {extra}; {REMEDY}")
            pre_roll = header.pop("pre_roll")
            if pre_roll != PRE_ROLL:
                refuse("pre_roll", pre_roll, f"{PRE_ROLL} samples")
            warnings = header.pop("warnings")
            if not isinstance(warnings, list):
                refuse("warnings", f"a JSON {type(warnings).__name__}", "a list of texts")
            told = tuple(printable(text) if isinstance(text, str) else text for text in warnings)
            texts = {name: printable(value) if isinstance(value, str) else value for name, value in header.items()}
            fields: dict[str, Any] = {
                **arrays,
                **texts,
                "warnings": told,
            }  # what type each has is checked on construction
            echo = EchoModel(fields.pop("impulse_response"), effects)
            profile = cls(echo=echo, **parts, **fields)
            _check_effects(echo)
            return profile
        except ProfileError as error:
            raise ProfileError(f"{path}: {error}") from None

    @property
    def learned(self) -> bool:
        """Whether speech has taught its path, to the running filter or as a whole recording, and no calibration."""
        return self.source in (LEARNED, PROVISIONAL)

    @property
    def microphones(self) -> int:
        """How many it was calibrated with."""
        return 1 if self.array is None else 1 + len(self.array.responses)

    def of_microphone(self, at: int) -> Profile:
        """The robot as one microphone of the array hears it: its path and its fan.

        Parameters
        ----------
        at : int
            Which one, from 0.

        Returns
        -------
        Profile
            Of one microphone. What a calibration says beside path and fan is of the first one in all of them.

        Raises
        ------
        ProfileError
            Where there is no such microphone.
        """
        if not 0 <= at < self.microphones:
            raise ProfileError(f"the profile holds {self.microphones} microphones, found microphone {at}, from 0")
        if self.array is None or at == 0:
            return replace(self, array=None)
        noise = np.ascontiguousarray(self.array.noise[:, at, at, 0])
        return replace(self, echo=self._models()[at], noise_psd=np.maximum(noise, 0.0), array=None)

    def running_responses(self) -> Samples:
        """The paths as the running filter begins with them, the effects that are filters in them.

        Returns
        -------
        ndarray of float32, shape (microphones, taps)
            A row a microphone, the first one's first.
        """
        return _stacked([model.running_response() for model in self._models()])

    def with_running_responses(self, responses: Samples, gain: float, effects: Effects) -> Profile:
        """The same robot with the paths to which the running filter has adapted them.

        Parameters
        ----------
        responses : ndarray of float32, shape (taps,) or (microphones, taps)
            What of a path is longer than the filter's is the profile's own.
        gain : float
            By which the volume was turned.
        effects : tuple of (name, values)
            Of the path in use.

        Returns
        -------
        Profile
            A new one.
        """
        models = [replace(model, effects=effects) for model in self._models()]
        echoes = [model.with_running_response(row, gain) for model, row in zip(models, np.atleast_2d(responses))]
        paths = [echo.impulse_response[:MAX_TAPS] for echo in echoes]
        array = self.array and replace(self.array, responses=_stacked(paths[1:]))
        return replace(self, echo=replace(echoes[0], impulse_response=paths[0]), array=array)

    def _models(self) -> list[EchoModel]:
        """The model of each microphone."""
        further = () if self.array is None else self.array.responses
        return [self.echo, *(replace(self.echo, impulse_response=response) for response in further)]

    def with_echo(self, echo: EchoModel) -> Profile:
        """The same robot with another model of its own voice, for example one with an effect added."""
        return replace(self, echo=echo)

    def noise_bins(self, stft: StftConfig) -> Samples:
        """Expected |X|^2 (bins,) float32 of the fan, as it is now, in one frame of stft."""
        psd = np.interp(stft.frequencies, GRID_HZ, self.echo.expected_noise(self.noise_psd))
        return (psd / 2 * SAMPLE_RATE * stft.noise_gain()).astype(np.float32)

    def response_bins(self, stft: StftConfig) -> Samples:
        """The paper's |H_m(f) H_s(f)| (bins,) float32 at the frequencies of stft; the stored values where n_fft is 1200."""
        return np.interp(stft.frequencies, GRID_HZ, self.response).astype(np.float32)


def _stacked(paths: Sequence[Samples]) -> Samples:
    """All paths, the shorter ones with zeros at their ends, (paths, taps)."""
    taps = max(path.size for path in paths)
    return np.stack([np.pad(path, (0, taps - path.size)) for path in paths])


def _check_effects(echo: EchoModel) -> None:
    """Raise ProfileError for an effect that is unknown, or whose values are not those that it can be applied with."""
    probe = np.zeros(SAMPLE_RATE // 10, np.float32)
    probe[::40] = 0.1
    for name, values in echo.effects:
        if name not in known_effects():
            remedy = "load its file (--effects FILE.py)"
            raise ProfileError(f"holds the effect '{name[:40]}', which does not come with edgefilter; {remedy}")
        try:
            complete(find(name), values)
            alone = EchoModel(echo.impulse_response, ((name, values),))
            with np.errstate(all="ignore"):
                added = [part for pair in alone.unpredictable(probe) for part in pair]
                made = [alone.predict(probe), alone.running_response(), *added]
        except Exception as error:  # whatever arrays of wrong shapes do to an effect's arithmetic
            told = " ".join(str(error).split())[:160]
            raise ProfileError(f"the values of its effect {name} cannot be used ({told}); {REMEDY}") from None
        if not all(np.isfinite(part).all() for part in made):
            raise ProfileError(f"the values of its effect {name} cannot be used (the result is not finite); {REMEDY}")
