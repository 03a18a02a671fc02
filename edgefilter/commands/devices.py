"""`edgefilter devices`: what PortAudio and the sound server see, and the virtual speaker and microphone."""

from __future__ import annotations

import argparse

from edgefilter.audio import device, pulse, virtual
from edgefilter.commands.display import print_result
from edgefilter.errors import EdgefilterError


def main(args: argparse.Namespace) -> None:
    if args.setup:
        print(virtual.setup())
    elif args.load:
        made = virtual.load()
        print(f"made: {', '.join(made)}" if made else "the virtual speaker and microphone are there already")
        print(f"now: {virtual.RUN}")
    elif args.unload:
        removed = virtual.unload()
        print(f"removed: {', '.join(removed)}" if removed else "there is nothing to remove")
    else:
        _list(args)


def _list(args: argparse.Namespace) -> None:
    devices = device.list_devices()
    server = {"inputs": pulse.names("input"), "outputs": pulse.names("output")}
    try:
        reference = str(device.monitor_of("default"))
    except EdgefilterError as error:
        reference = f"none ({error})"
    lines = ["{index:3d}  in {inputs:<3d} out {outputs:<3d} {rate:6.0f} Hz  {name}".format(**each) for each in devices]
    lines += [f"sound server, {kind[:-1]:6}  {name}" for kind, names in server.items() for name in names]
    lines = [*(lines or ["no sound devices found"]), f"a live run would take its reference from: {reference}"]
    print_result(args, lines, {"devices": devices, "server": server, "reference": reference})
