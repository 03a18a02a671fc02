"""`edgefilter devices`: what PortAudio sees, by the numbers and names that the other commands take."""

from __future__ import annotations

import argparse

from edgefilter.commands.display import write_json
from edgefilter.errors import UsageError


def main(args: argparse.Namespace) -> int:
    from edgefilter.audio.device import list_devices, monitor_of

    devices = list_devices()
    try:
        reference = str(monitor_of("default"))
    except UsageError as error:
        reference = f"none ({error})"
    if args.json:
        write_json({"devices": devices, "reference": reference}, args.json)
    if args.json == "-":
        return 0
    if not devices:
        print("no sound devices found")
    for device in devices:
        print("{index:3d}  in {inputs:<3d} out {outputs:<3d} {rate:6.0f} Hz  {name}".format(**device))
    print(f"live, the reference would come from: {reference}")
    return 0
