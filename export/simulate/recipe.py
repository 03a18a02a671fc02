"""What simulated conversations are like: ranges as data, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass, replace

from edgefilter.echo.measurement import Values
from export.simulate.linear_stage import BenchSetting, Setting, WideSetting

Range = tuple[float, float]
"""Low and high, drawn uniformly between."""


@dataclass(frozen=True)
class Recipe:
    """Ranges and shares; those of a plain conversation are the defaults, what else reality has is off.

    Levels, dB. human_gain: the human's power over the robot's at the microphone; near: the same, of the share
    near_share, in which the human is about as loud. fan: the human over the fan, quiet_fan: share with a faint one.
    level: of the robot at the microphone over -22 dB of full scale. distortion: over the loudspeaker's linear sound.

    Shares of the items. office, hall: rooms, the rest is lab. warm: start from a calibrated profile; wrong: from one of
    another robot, room or fan (counted apart from warm). human: somebody speaks. robot: it speaks at all. moving: lag,
    clock and volume change. far_human: the far end is a person instead of a voice from text. other_voices: of robots and of
    humans, whose voice is played faster or slower and so is another's. plain: drawn by the recipe BENCHMARK instead.

    processed: the device suppresses noise before anybody hears the microphone. motors: the robot moves while it talks, with
    a noise that follows its voice. hum: a constant offset and mains hum at the microphone. soft: the human's utterances rise
    from nothing. knocks: of what stands near, as loud as the human, while the human is silent.

    later: the filter has run for as long as the item already, and has learned meanwhile as it does in use.

    Apart from that. seconds: of one item. lag_s, ppm, volume_db: of moving items. silence_s: before the human speaks.
    kinds: of distortion, see loudspeaker.KINDS. wideness: of microphone, noise and path, 0 for none of their defects
    and 1 for the shares in microphone.py, fan.py and path.py. effects: (name, values) of a profile's effects, in
    effects_share of the items. catalogue: share with one or two effects of the catalogue at random. setting: how the
    linear stage's settings are drawn.
    """

    seconds: float = 12.0
    office: float = 0.6
    hall: float = 0.0
    human_gain_db: Range = (-30.0, -16.0)
    near_share: float = 0.0
    near_db: Range = (-8.0, 10.0)
    level_db: Range = (-10.0, 6.0)
    fan_db: Range = (3.0, 14.0)
    quiet_fan: float = 0.15
    warm: float = 0.75
    wrong: float = 0.0
    human: float = 0.92
    robot: float = 1.0
    far_human: float = 0.0
    other_voices: float = 0.0
    moving: float = 0.4
    lag_s: Range = (0.0, 0.8)
    ppm: Range = (-150.0, 150.0)
    volume_db: Range = (-3.0, 3.0)
    kinds: tuple[str, ...] = ("driver",)
    distortion_db: Range = (-32.0, -14.0)
    silence_s: Range = (0.0, 5.0)
    wideness: float = 0.0
    effects: tuple[tuple[str, Values], ...] = ()
    effects_share: float = 0.5
    catalogue: float = 0.0
    later: float = 0.0
    processed: float = 0.0
    motors: float = 0.0
    hum: float = 0.0
    soft: float = 0.0
    knocks: float = 0.0
    setting: Setting = BenchSetting()
    plain: float = 0.0


BENCHMARK = Recipe()
"""Robots as the benchmark simulates them: the human 16 to 30 dB below, one family of loudspeakers, mostly calibrated."""
PAPER = Recipe(
    seconds=5.0,
    office=6200 / 8000,
    human_gain_db=(-25.0, -25.0),
    fan_db=(6.0, 7.0),
    quiet_fan=0.0,
    human=1.0,
    moving=0.0,
    silence_s=(0.5, 1.5),
)
"""Li, Hindriks & Kunneman (2024), section 4: 5 s, 1800 items in a laboratory and 6200 in an office, human at -25 dB
after 0.5-1.5 s."""
WIDE = Recipe(
    office=0.45,
    hall=0.15,  # RT60 to 1 s; a robot also stands in corridors
    human_gain_db=(-32.0, -8.0),
    near_share=1 / 3,  # a network that never met a human as loud as the robot deletes that human
    level_db=(-20.0, 6.0),
    fan_db=(0.0, 40.0),
    quiet_fan=0.0,
    warm=0.5,
    wrong=0.15,  # a profile of another day, robot or room is what most users will have
    human=0.78,  # the rest is the robot alone, from which the speech head learns what nobody speaking is like
    robot=0.9,  # the rest is the human alone, who has to come out untouched
    far_human=0.3,  # telephony: the far end is not a synthetic voice
    lag_s=(0.0, 1.2),
    ppm=(-300.0, 300.0),
    volume_db=(-6.0, 6.0),
    kinds=("driver", "soft", "hard", "crossover", "compressor", "rattle", "codec", "multiband", "flutter"),
    distortion_db=(-45.0, -10.0),  # real loudspeakers leave -16 to -24 dB after the best linear filter
    wideness=1.0,
    catalogue=0.3,
    later=0.15,  # what a robot hears after the first seconds of a run; such an item takes ten times as long to simulate
    setting=WideSetting(),
    plain=0.3,  # what the benchmark measures must stay in the training
)
"""As wide as reality is known to be: ranges by experiment on real recordings and from the catalogue of effects."""
MICROPHONE = replace(WIDE, later=0.0)
"""WIDE for networks that get the microphone alone: what the filter has learned before cannot matter to them."""
VOICES = replace(MICROPHONE, other_voices=0.5)
"""MICROPHONE with more voices than there are: of synthetic ones few are at hand, and robots have any."""
DEVICES = replace(VOICES, processed=0.2, later=0.03, setting=WideSetting(lost=0.1, displaced_s=0.06))
"""VOICES with devices on which no linear stage helps: what is left is the reference's magnitudes, about aligned."""
FIELD = replace(DEVICES, motors=0.2, hum=0.1, soft=0.3, knocks=0.3, distortion_db=(-45.0, -5.0), plain=0.2)
"""DEVICES with robots that move while they talk, cheap microphones and louder distortion; with humans who begin softly, since
recordings of speech are trimmed at 34 dB below their peak, and so begin abruptly; and with short sounds as loud as a human,
since in other recipes every sound as loud is a human. References never stop: a network that was trained with some that did
took a loud human beside a silent reference for the robot (gf_655836 in real2)."""
GESTURES = replace(FIELD, motors=0.6)
"""FIELD with more robots that move: gears that whine are the sound that a network which had not heard them took for a human most."""
RECIPES = {
    "edge": BENCHMARK,
    "paper": PAPER,
    "wide": WIDE,
    "microphone": MICROPHONE,
    "voices": VOICES,
    "devices": DEVICES,
    "field": FIELD,
    "gestures": GESTURES,
}
