#!/bin/sh
# The same as batch.sh with GNU parallel: a progress bar, a log of times, --resume after a stop, and more machines.
#   scripts/batch_parallel.sh FOLDER [OUT]        frames as FOLDER/NAME.npz, or NAME.png beside NAME.json (the camera)
#   parallel reads more machines from ~/.parallel/sshloginfile: add --sshloginfile .. where derender is installed there
set -eu
folder=${1:?say which: scripts/batch_parallel.sh FOLDER [OUT]}
out=${2:-results}
command -v parallel >/dev/null || { echo "GNU parallel is missing: apt-get install parallel, or use batch.sh" >&2; exit 1; }
mkdir -p "$out"

set +e
parallel --bar --resume --joblog "$out/log.tsv" \
    derender infer '{}' --jobs 1 --seed 1 --quiet -o "$out/{/.}" ::: "$folder"/*.npz
parallel --bar --resume --joblog "$out/log_png.tsv" \
    derender infer '{}' --camera '{.}.json' --jobs 1 --seed 1 --quiet -o "$out/{/.}" ::: "$folder"/*.png
true
