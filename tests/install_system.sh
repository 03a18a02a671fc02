#!/bin/sh
# Installs what the tests need from the system: virtual sound devices, PortAudio, a browser, SpeexDSP, systemd's own checks, a Redis server,
# and what PyAudio is built with, which the Social Interaction Cloud asks for.
packages="pulseaudio pulseaudio-utils libasound2-plugins libportaudio2 chromium libspeexdsp1 systemd"
packages="$packages pipewire pipewire-pulse wireplumber dbus redis-server"
packages="$packages gcc libc6-dev python3-dev portaudio19-dev"  # for PyAudio and the example in C
missing=""
for package in $packages; do
    dpkg -s "$package" >/dev/null 2>&1 || missing="$missing $package"
done
[ -z "$missing" ] && exit 0
if [ "$(id -u)" = 0 ]; then
    apt-get update -q && DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends $missing
    exit $?
fi
echo "missing:$missing; run: sudo apt-get install -y --no-install-recommends$missing" >&2
exit 1
