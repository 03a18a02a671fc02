"""A virtual speaker for the robot and a virtual microphone for all other programs, on PulseAudio or pipewire-pulse.

As with module-echo-cancel, sound that is played to the speaker goes on to the default output and is the reference; the microphone
carries the output of `edgefilter run`.
"""

from __future__ import annotations

from edgefilter.audio import pulse
from edgefilter.audio.pulse import STAND_INS, Device
from edgefilter.errors import DeviceError, UsageError

SPEAKER, HUMAN, MICROPHONE = "edgefilter_speaker", "edgefilter_human", "edgefilter_mic"
"""Where the robot plays, where the filter writes, and where others listen: a source of its own, since many programs
offer no monitors."""
MODULES = {
    SPEAKER: f"module-remap-sink sink_name={SPEAKER} sink_properties=device.description={SPEAKER}",
    HUMAN: f"module-null-sink sink_name={HUMAN} rate=16000 channels=1 sink_properties=device.description={HUMAN}",
    MICROPHONE: f"module-remap-source source_name={MICROPHONE} master={HUMAN}.monitor"
    f" source_properties=device.description={MICROPHONE}",
}
"""The server's module behind each device, in the order in which they are made."""
RUN = f"edgefilter run --input mic --output {HUMAN}"


def setup() -> str:
    """What to type, and what to write into which file to have it for good; all but the commands are comments."""
    load = [f"load-module {module}" for module in MODULES.values()]
    commands = [f'{{ cmd = "load-module" args = "{module}" flags = [ ] }}' for module in MODULES.values()]
    lines = [
        f"# The robot plays into {SPEAKER}, others listen to {MICROPHONE}. Until the sound server ends, as --load does:",
        *(f"pactl {line}" for line in load),
        "# Then:",
        f"#   {RUN}",
        "# For good with PulseAudio, at the end of ~/.config/pulse/default.pa (begin it with .include /etc/pulse/default.pa):",
        *(f"#   {line}" for line in load),
        "# For good with PipeWire, as ~/.config/pipewire/pipewire-pulse.conf.d/edgefilter.conf:",
        *(f"#   {line}" for line in ("pulse.cmd = [", *(f"  {command}" for command in commands), "]")),
    ]
    return "\n".join(lines)


def load() -> list[str]:
    """Make the devices that are not there yet and return their names.

    Raises DeviceError where there is no server or it refuses one; none is left behind then.
    """
    there = {*pulse.names("output"), *pulse.names("input")}
    made: list[tuple[str, str]] = []
    for name, module in MODULES.items():
        if name not in there:
            try:
                made.append((name, pulse.pactl("load-module", *module.split()).strip()))
            except DeviceError:
                for _, number in reversed(made):
                    pulse.pactl("unload-module", number)
                raise
    return [name for name, _ in made]


def unload() -> list[str]:
    """Remove the devices, however they were made, and return the names of those that were there; raises DeviceError."""
    loaded = [line.split("\t") for line in pulse.pactl("list", "short", "modules").splitlines()]
    removed = []
    for name in reversed(MODULES):
        for number, _, arguments, *_ in (fields for fields in loaded if len(fields) > 2):
            if {f"sink_name={name}", f"source_name={name}"} & {*arguments.split()}:
                pulse.pactl("unload-module", number)
                removed.append(name)
    return removed


def refuse_own(microphone: Device) -> None:
    """Raise UsageError where the microphone is the filter's own output: it would hear itself, or nothing."""
    leads_to_default = microphone.name in STAND_INS and not microphone.pulse_name
    meant = pulse.default_name("input") if leads_to_default else microphone.name
    if meant in (MICROPHONE, f"{HUMAN}.monitor"):
        raise UsageError(
            f"microphone '{meant}' is edgefilter's own output: name the real one with --input ('edgefilter devices'), or"
            " make that the default again ('pactl set-default-source NAME')"
        )
