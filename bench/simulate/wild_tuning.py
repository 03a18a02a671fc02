"""Programs to tune on: SoX, swh-plugins, pyroomacoustics, Speex, WebRTC."""

from __future__ import annotations

import numpy as np

from bench.simulate.hidden_strength import log_uniform
from bench.simulate.wild_programs import Program, echoes_ms, either, gains, volume
from bench.simulate.wild_tools import Command, coded, ladspa, ladspa_by_rate, sox, webrtc

Rng = np.random.Generator


def _shelves(r: Rng) -> Command:
    return sox("bass", f"{either(r, 3, 9):.1f}", "treble", f"{either(r, 3, 9):.1f}")


def _parametric(r: Rng) -> Command:
    bands = [(either(r, 3, 9), f * r.uniform(0.7, 1.4), r.uniform(0.8, 2.5)) for f in (350.0, 1200.0, 3500.0)]
    low, high = (either(r, 0, 5), r.uniform(150, 300), 0.5), (either(r, 2, 6), r.uniform(3500, 6000), 0.5)
    return ladspa_by_rate("triple_para_1204", "triplePara", *(value for band in (low, *bands, high) for value in band))


def _sox_echo(r: Rng) -> Command:
    pairs = [word for ms in echoes_ms(r, int(r.integers(1, 4))) for word in (ms, round(float(r.uniform(0.15, 0.4)), 2))]
    return sox("echo", 1.0, 1.0, *pairs)


def _sox_compand(r: Rng) -> Command:
    knee, ratio = r.uniform(-36, -24), r.uniform(2.5, 6)
    times = f"{r.uniform(0.003, 0.02):.3f},{r.uniform(0.1, 0.5):.2f}"
    return sox("compand", times, f"6:-90,-90,{knee:.1f},{knee:.1f},0,{knee * (1 - 1 / ratio):.1f}", "0", "-30")


def _sox_multiband(r: Rng) -> Command:
    def band() -> str:
        knee, ratio = r.uniform(-45, -30), r.uniform(2.0, 6.0)
        times = f"{r.uniform(0.003, 0.01):.3f},{r.uniform(0.08, 0.3):.2f}"
        return f"{times} 6:-90,-90,{knee:.1f},{knee:.1f},0,{knee * (1 - 1 / ratio):.1f} 0 -30"

    return sox("mcompand", band(), f"{r.uniform(300, 700):.0f}", band(), f"{r.uniform(1500, 3000):.0f}", band())


TUNING: tuple[Program, ...] = (
    Program("sox bass, treble", "source", ("equaliser",), _shelves),
    Program("swh triplePara", "source", ("equaliser",), _parametric),
    Program(
        "swh dj_eq",
        "source",
        ("equaliser",),
        lambda r: ladspa("dj_eq_1901", "dj_eq_mono", *gains(r, 3, 6.0), rate=48000),
    ),
    Program("sox echo", "room", ("early_path",), _sox_echo),
    Program("pyroomacoustics, microphone moved", "room", ("early_path",), None),
    Program("pyroomacoustics, robot moved", "room", ("early_path",), None),
    Program(
        "swh gverb",
        "room",
        ("late_reverb",),
        lambda r: ladspa(
            "gverb_1216", "gverb", r.uniform(8, 25), r.uniform(0.5, 1.2), 0.3, 0.8, 0, -70, r.uniform(-24, -16)
        ),
    ),
    Program(
        "sox reverb",
        "room",
        ("late_reverb",),
        lambda r: sox("reverb", f"{r.uniform(50, 90):.0f}", "50", f"{r.uniform(50, 100):.0f}", "100", "0", "-6"),
    ),
    Program(
        "swh valve",
        "source",
        ("speaker_nonlinearity",),
        lambda r: ladspa("valve_1209", "valve", r.uniform(0.3, 0.9), r.uniform(0.1, 0.9)),
    ),
    Program(
        "swh foverdrive",
        "source",
        ("speaker_nonlinearity",),
        lambda r: ladspa("foverdrive_1196", "foverdrive", r.uniform(1.5, 3)),
    ),
    Program(
        "sox overdrive",
        "source",
        ("speaker_nonlinearity", "playback_gain"),  # its gain raises the level as well
        lambda r: sox("overdrive", f"{r.uniform(3, 12):.1f}", f"{r.uniform(5, 30):.0f}"),
    ),
    Program(
        "swh fastLookaheadLimiter",
        "source",
        ("limiter", "compression"),  # a limiter is a compressor of infinite ratio
        lambda r: ladspa(
            "fast_lookahead_limiter_1913",
            "fastLookaheadLimiter",
            0,
            r.uniform(-18, -8),
            log_uniform(r, 0.03, 0.6),
            channels=2,
        ),
    ),
    Program(
        "swh hardLimiter",
        "source",
        ("speaker_nonlinearity", "limiter"),  # it clips, which an amplifier's limiter does as well
        lambda r: ladspa("hard_limiter_1413", "hardLimiter", r.uniform(-16, -8), 1, 0),
    ),
    Program(
        "swh hardLimiter behind the microphone",
        "microphone",
        ("mic_clipping",),
        lambda r: ladspa("hard_limiter_1413", "hardLimiter", r.uniform(-22, -16), 1, 0),
    ),
    Program(
        "swh sc4m",
        "source",
        ("compression",),
        lambda r: ladspa(
            "sc4m_1916",
            "sc4m",
            r.uniform(0, 0.5),
            log_uniform(r, 2, 30),
            log_uniform(r, 60, 500),
            r.uniform(-30, -20),
            r.uniform(2.5, 10),
            r.uniform(1, 8),
            r.uniform(0, 6),
        ),
    ),
    Program("sox compand", "source", ("compression",), _sox_compand),
    Program("sox mcompand", "source", ("multiband_compression",), _sox_multiband),
    Program(
        "webrtc noise suppression", "microphone", ("noise_suppression",), lambda r: webrtc(0, int(r.integers(1, 5)))
    ),
    Program("webrtc gain control", "microphone", ("mic_agc",), lambda r: webrtc(int(r.integers(5, 20)), 0)),
    Program(
        "speex",
        "source",
        ("codec",),
        lambda r: coded(
            f"speexenc --wideband --quality {r.integers(3, 9)} {{wav}} {{packed}}", "speexdec {packed} {out}"
        ),
    ),
    Program(
        "speex, packets lost",
        "source",
        ("codec",),
        lambda r: coded(
            "speexenc --wideband --quality 8 {wav} {packed}",
            f"speexdec --packet-loss {r.integers(3, 15)} {{packed}} {{out}}",
        ),
    ),
    Program(
        "swh buttlow",
        "source",
        ("bandlimit", "equaliser"),  # of second order: 12 dB an octave
        lambda r: ladspa_by_rate("butterworth_1902", "buttlow_iir", r.uniform(1800, 4500), r.uniform(0.6, 1.41)),
    ),
    Program("sox sinc", "source", ("bandlimit",), lambda r: sox("sinc", f"-{r.uniform(2500, 5500):.0f}")),
    Program("sox speed", "source", ("clock_drift",), lambda r: sox("speed", f"{1 + either(r, 3e-5, 3e-4):.6f}")),
    Program("sox gain", "source", ("playback_gain",), lambda r: sox("gain", f"{volume(r):.1f}")),
    Program(
        "sox equalizer, narrow",
        "source",
        ("chassis_resonance", "equaliser"),  # one peak, which is an equaliser's band as well
        lambda r: sox(
            "equalizer", f"{log_uniform(r, 250, 4000):.0f}", f"{r.uniform(8, 30):.1f}q", f"{r.uniform(6, 15):.1f}"
        ),
    ),
    Program(
        "sox tremolo",
        "source",
        ("unknown",),
        lambda r: sox("tremolo", f"{r.uniform(3, 9):.1f}", f"{r.uniform(40, 80):.0f}"),
    ),
    Program(
        "sox flanger",
        "source",
        ("unknown",),
        lambda r: sox("flanger", 0, f"{r.uniform(1, 4):.1f}", 0, 70, f"{r.uniform(0.5, 2):.1f}"),
    ),
)
