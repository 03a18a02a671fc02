"""`edgefilter devices`: what PortAudio and the sound server see, and the virtual speaker and microphone."""

from __future__ import annotations

import argparse

from edgefilter.audio import pulse, virtual
from edgefilter.commands.display import write_json
from edgefilter.errors import UsageError


def main(args: argparse.Namespace) -> int:
    if args.setup:
        print(virtual.setup())
    elif args.load:
        made = virtual.load()
        print(f"made: {', '.join(made)}" if made else "all are there already")
        print(f"now: {virtual.RUN}")
    elif args.unload:
        removed = virtual.unload()
        print(f"removed: {', '.join(removed)}" if removed else "there is nothing to remove")
    else:
        show(args.json)
    return 0


def show(json: str | None) -> None:
    """Print the devices, or write them as JSON."""
    from edgefilter.audio.device import list_devices, monitor_of

    devices = list_devices()
    server = {"inputs": pulse.names("input"), "outputs": pulse.names("output")}
    try:
        reference = str(monitor_of("default"))
    except UsageError as error:
        reference = f"none ({error})"
    if json:
        write_json({"devices": devices, "server": server, "reference": reference}, json)
    if json == "-":
        return
    if not devices:
        print("no sound devices found")
    for device in devices:
        print("{index:3d}  in {inputs:<3d} out {outputs:<3d} {rate:6.0f} Hz  {name}".format(**device))
    for kind, names in server.items():
        for name in names:
            print(f"sound server, {kind[:-1]:6}  {name}")
    print(f"live, the reference would come from: {reference}")
