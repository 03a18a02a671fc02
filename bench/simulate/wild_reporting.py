"""Programs to report on, never to tune on: ffmpeg, tap, caps, cmt, invada, vlevel, LAME, Opus, GSM, pedalboard, noisereduce."""

from __future__ import annotations

import numpy as np

from bench.simulate.hidden_strength import log_uniform
from bench.simulate.wild_programs import Program, echoes_ms, either, gains, volume
from bench.simulate.wild_tools import Command, coded, ffmpeg, ladspa, noisereduce, pedalboard

Rng = np.random.Generator


_TOAST = "sox {wav} -t gsm {packed}"
_UNTOAST = "sox -t gsm -r 8000 {packed} {out}"


def _tap_eq(r: Rng) -> Command:
    return ladspa("tap_eq", "tap_equalizer", 0, *gains(r, 5), 0, 0, 100, 200, 450, 1000, 2200, 4500, 12000, 15000)


def _firequalizer(r: Rng) -> Command:
    bands = zip((60, 250, 600, 1400, 3000, 7500), [0.0, *gains(r, 5)], strict=True)
    return ffmpeg("firequalizer=gain_entry='" + ";".join(f"entry({hz},{db})" for hz, db in bands) + "'")


def _aecho(r: Rng) -> Command:
    delays = echoes_ms(r, int(r.integers(1, 4)))
    decays = [f"{r.uniform(0.15, 0.4):.2f}" for _ in delays]
    return ffmpeg(f"aecho=1:1:{'|'.join(map(str, delays))}:{'|'.join(decays)}")


REPORTING: tuple[Program, ...] = (
    Program("tap equalizer", "source", ("equaliser",), _tap_eq),
    Program(
        "caps Eq10",
        "source",
        ("equaliser",),
        lambda r: ladspa("caps", "Eq10", 0, 0, 0, *gains(r, 5), gains(r, 1)[0], 0),
    ),
    Program(
        "caps CabinetIII",
        "source",
        ("equaliser",),
        lambda r: ladspa("caps", "CabinetIII", int(r.integers(0, 17)), 0, r.uniform(-3, 3)),
    ),
    Program(
        "pedalboard HighShelfFilter",
        "source",
        ("equaliser",),
        lambda r: pedalboard("HighShelfFilter", cutoff_frequency_hz=r.uniform(900, 3500), gain_db=either(r, 3, 9)),
    ),
    Program("ffmpeg firequalizer", "source", ("equaliser",), _firequalizer),
    Program("ffmpeg aecho", "room", ("early_path",), _aecho),
    Program(
        "cmt delay_0.01s",
        "room",
        ("early_path",),
        lambda r: ladspa("cmt", "delay_0.01s", r.uniform(0.0015, 0.009), r.uniform(0.15, 0.4)),
    ),
    Program(
        "tap reverb",
        "room",
        ("late_reverb",),
        lambda r: ladspa(
            "tap_reverb",
            "tap_reverb",
            r.uniform(700, 2000),
            0,
            r.uniform(-22, -12),
            1,
            1,
            1,
            0,
            int(r.integers(0, 43)),
            channels=2,
        ),
    ),
    Program(
        "caps Plate",
        "room",
        ("late_reverb",),
        lambda r: ladspa("caps", "Plate", 0.7, r.uniform(0.3, 0.7), 0.4, r.uniform(0.1, 0.3)),
    ),
    Program(
        "cmt freeverb3",
        "room",
        ("late_reverb",),
        lambda r: ladspa("cmt", "freeverb3", 0, r.uniform(0.3, 0.7), 0.3, r.uniform(0.1, 0.3), 0.7, 0.5, channels=2),
    ),
    Program(
        "tap sigmoid",
        "source",
        ("speaker_nonlinearity", "playback_gain"),  # its pre-gain raises the level
        lambda r: ladspa("tap_sigmoid", "tap_sigmoid", r.uniform(2, 10), r.uniform(-6, 0)),
    ),
    Program(
        "tap tubewarmth",
        "source",
        ("speaker_nonlinearity",),
        lambda r: ladspa("tap_tubewarmth", "tap_tubewarmth", r.uniform(2, 9), r.uniform(0, 10)),
    ),
    Program(
        "invada tube",
        "source",
        ("speaker_nonlinearity",),
        lambda r: ladspa("inv_tube", "invada_mono_tube_module_0_1", r.uniform(3, 15), r.uniform(-0.4, 0.4), 0, 75),
    ),
    Program(
        "ffmpeg asoftclip",
        "source",
        ("speaker_nonlinearity",),
        lambda r: ffmpeg(f"asoftclip=type={r.choice(['tanh', 'atan', 'cubic', 'exp', 'alg'])}"),
    ),
    Program(
        "ffmpeg alimiter",
        "source",
        ("limiter", "compression"),
        lambda r: ffmpeg(
            f"alimiter=limit={r.uniform(0.12, 0.35):.3f}:attack={r.uniform(2, 8):.1f}"
            f":release={log_uniform(r, 30, 400):.0f}:level=0"
        ),
    ),
    Program(
        "tap limiter",
        "source",
        ("limiter", "compression"),
        lambda r: ladspa("tap_limiter", "tap_limiter", r.uniform(-18, -8), 0),
    ),
    Program(
        "pedalboard Limiter",
        "source",
        ("limiter", "compression"),
        lambda r: pedalboard("Limiter", threshold_db=r.uniform(-24, -14), release_ms=log_uniform(r, 40, 400)),
    ),
    Program(
        "ffmpeg acompressor",
        "source",
        ("compression",),
        lambda r: ffmpeg(
            f"acompressor=threshold={r.uniform(-34, -22):.0f}dB:ratio={r.uniform(2.5, 8):.1f}"
            f":attack={log_uniform(r, 2, 30):.1f}:release={log_uniform(r, 60, 500):.0f}"
        ),
    ),
    Program(
        "invada compressor",
        "source",
        ("compression",),
        lambda r: ladspa(
            "inv_compressor",
            "invada_mono_compressor_module_0_1",
            r.uniform(0, 0.6),
            log_uniform(r, 1, 20),
            log_uniform(r, 60, 500),
            r.uniform(-34, -24),
            r.uniform(2.5, 8),
            0,
            0,
        ),
    ),
    Program(
        "pedalboard Compressor",
        "source",
        ("compression",),
        lambda r: pedalboard(
            "Compressor",
            threshold_db=r.uniform(-34, -24),
            ratio=r.uniform(2.5, 8),
            attack_ms=log_uniform(r, 1, 20),
            release_ms=log_uniform(r, 60, 500),
        ),
    ),
    Program(
        "ffmpeg mcompand",
        "source",
        ("multiband_compression",),
        lambda r: ffmpeg(
            "mcompand=0.005\\,0.1 6 -47/-40\\,-34/-34\\,-17/-33 300 | 0.003\\,0.05 6 -47/-40\\,-34/-34\\,-17/-33 1400 |"
            f" 0.000625\\,{r.uniform(0.01, 0.05):.4f} 6 -47/-40\\,-34/-34\\,-15/-33 7900"
        ),
    ),
    Program(
        "ffmpeg afftdn",
        "microphone",
        ("noise_suppression",),
        lambda r: ffmpeg(f"afftdn=nr={r.uniform(8, 25):.0f}:nf=-50:tn=1"),
    ),
    Program(
        "noisereduce",
        "microphone",
        ("noise_suppression",),
        lambda r: noisereduce(stationary=True, prop_decrease=r.uniform(0.6, 1.0)),
    ),
    Program(
        "ffmpeg dynaudnorm",
        "microphone",
        ("mic_agc",),
        lambda r: ffmpeg(f"dynaudnorm=f={r.integers(200, 800)}:g=5:m=6"),
    ),
    Program(
        "vlevel",
        "microphone",
        ("mic_agc",),
        lambda r: ladspa(
            "vlevel-ladspa", "vlevel_mono", r.uniform(0.3, 1.5), r.uniform(0.3, 0.7), 1, r.uniform(3, 8), 0
        ),
    ),
    Program("toast", "source", ("codec", "bandlimit"), lambda r: coded(_TOAST, _UNTOAST, 8000)),  # narrow band, too
    Program(
        "lame",
        "source",
        ("codec",),
        lambda r: coded(f"lame -m m -b {r.choice([8, 16, 24, 32])} {{wav}} {{packed}}", "lame --decode {packed} {out}"),
    ),
    Program(
        "opus, packets lost",
        "source",
        ("codec",),
        lambda r: coded(
            "opusenc --bitrate 32 {wav} {packed}",
            f"opusdec --rate 16000 --packet-loss {r.integers(3, 15)} {{packed}} {{out}}",
        ),
    ),
    Program(
        "pedalboard Clipping",
        "microphone",
        ("mic_clipping",),
        lambda r: pedalboard("Clipping", threshold_db=r.uniform(-22, -16)),
    ),
    Program(
        "pedalboard LadderFilter",
        "source",
        ("bandlimit", "equaliser"),  # 24 dB an octave, and a colour below
        lambda r: pedalboard("LadderFilter", cutoff_hz=r.uniform(2000, 4500), resonance=0.0, drive=1.0),
    ),
    Program(
        "ffmpeg asetrate",
        "source",
        ("clock_drift",),
        lambda r: ffmpeg(f"aresample=160000,asetrate={160000 + round(either(r, 6, 45))},aresample=16000"),
    ),
    Program("ffmpeg volume", "source", ("playback_gain",), lambda r: ffmpeg(f"volume={volume(r):.1f}dB")),
    Program(
        "ffmpeg tremolo",
        "source",
        ("unknown",),
        lambda r: ffmpeg(f"tremolo=f={r.uniform(3, 9):.1f}:d={r.uniform(0.4, 0.8):.2f}"),
    ),
    Program(
        "pedalboard Chorus",
        "source",
        ("unknown",),
        lambda r: pedalboard("Chorus", rate_hz=r.uniform(0.5, 3), depth=r.uniform(0.1, 0.3), mix=r.uniform(0.3, 0.5)),
    ),
)
