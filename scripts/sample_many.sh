#!/bin/sh
# Make a data set: N scenes of a prior with their clean depth, a Kinect-like image and a picture of each.
#   scripts/sample_many.sh N [PRIOR [OUT]]
set -eu
count=${1:?say how many: scripts/sample_many.sh N [PRIOR [OUT]]}
prior=${2:-tabletop}
out=${3:-dataset}
mkdir -p "$out"
derender sample "$prior" -n "$count" --seed 1 --no-noise -o "$out"
ls "$out"/*.yaml | xargs -n 20 -P "$(nproc)" sh -c '
    out=$1; shift
    derender render "$@" --sensor kinect --seed 1 -q -o "$out/{}.kinect.npz"
    derender render "$@" --preview -q -o "$out/{}.png"' sh "$out"
