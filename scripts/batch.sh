#!/bin/sh
# Infer every depth image of a folder, one process for each core, and collect a table.
#   scripts/batch.sh FOLDER [CAMERA [OUT]]
# CAMERA is a camera file for all of them; an .npz of derender needs none. A frame that has a result already is left
# alone, so the same command goes on where it was stopped; one that fails does not stop the others.
set -eu
folder=$1
camera=${2:-}
out=${3:-results}
mkdir -p "$out"

find "$folder" -type f \( -name '*.png' -o -name '*.npy' -o -name '*.npz' -o -name '*.tiff' -o -name '*.exr' \) |
    sort | xargs -P "$(nproc)" -I '{}' sh -c '
        frame=$1 camera=$2 out=$3/$(basename "${1%.*}")
        test -f "$out/summary.json" && exit 0
        mkdir -p "$out"
        if derender infer "$frame" ${camera:+--camera "$camera"} --jobs 1 --seed 1 --quiet -o "$out" 2>"$out/log.txt"
        then echo "done   $frame"
        else echo "failed $frame: $(tail -n 1 "$out/log.txt")"
        fi' sh '{}' "$camera" "$out"

# One line for each frame: its name and its objects.
for result in "$out"/*/scene.yaml; do
    test -f "$result" || continue
    derender show "$(dirname "$result")" --json |
        python3 -c '
import json, sys
scene = json.load(sys.stdin)
objects = [o for o in scene["objects"] if o["size"]]
print(sys.argv[1], len(objects), " ".join("%s on %s" % (o["name"], o["parent"]) for o in objects), sep="\t")
' "$(basename "$(dirname "$result")")"
done > "$out/table.tsv"
echo "wrote $out/table.tsv"
