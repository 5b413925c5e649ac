#!/bin/sh
# Get a library for drawing without a screen, where root and apt allow it; otherwise say how and go on.
# derender works without it: then its own renderer, raycast, draws everything.

has() { ldconfig -p 2>/dev/null | grep -q "$1" || ls /usr/lib/*/"$1"* /usr/lib*/"$1"* >/dev/null 2>&1; }

if has libOSMesa.so || has libEGL.so; then
    exit 0
fi
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    echo "Installing OSMesa for the pyrender renderer ..." >&2
    export DEBIAN_FRONTEND=noninteractive
    install() { timeout 120 apt-get install -y -qq --no-install-recommends "$@" >/dev/null 2>&1; }
    install libosmesa6 && exit 0
    timeout 60 apt-get update -qq >/dev/null 2>&1
    install libosmesa6 || install libegl1 libgl1-mesa-dri libopengl0 libgl1
fi
if ! has libOSMesa.so && ! has libEGL.so; then
    echo "No OSMesa or EGL: going on with our own renderer. To get it: sudo apt-get install libosmesa6" >&2
fi
exit 0
