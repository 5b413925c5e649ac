#!/bin/sh
# Infer every depth image of a folder and those below it, one process for each core, and collect a table.
#   scripts/batch.sh FOLDER [CAMERA [OUT]]
# CAMERA is a camera file for all of them; an .npz of derender needs none. A frame that has a result already is left
# alone, so the same command goes on where it was stopped; one that fails does not stop the others. Exit status: 0, or 1
# where any failed.
set -eu
folder=${1:?say which: scripts/batch.sh FOLDER [CAMERA [OUT]]}
camera=${2:-}
out=${3:-results}
test -d "$folder" || { echo "$folder: there is no such folder" >&2; exit 1; }
mkdir -p "$out"

(cd "$folder" && find . -type f \( -name '*.png' -o -name '*.np[yz]' -o -name '*.tif' -o -name '*.tiff' \
    -o -name '*.exr' \) -print0) | sort -z | xargs -0 -P "$(nproc)" -I '{}' sh -c '
        name=${1#./} camera=$2
        frame=$4/$name out=$3/${name%.*}
        test -f "$out/summary.json" && exit 0
        test -f "${frame%/*}/summary.json" && exit 0 # part of a result, no frame
        mkdir -p "$out"
        if derender infer "$frame" ${camera:+--camera "$camera"} --jobs 1 --seed 1 --quiet -o "$out" \
            >"$out/table.txt" 2>"$out/log.txt"
        then echo "done   $frame"
        else echo "failed $frame: $(tail -n 1 "$out/log.txt")"
        fi' sh '{}' "$camera" "$out" "$folder"

# One line for each frame: its name and its objects.
python3 - "$out" >"$out/table.tsv" <<'END'
import json, pathlib, sys

out = pathlib.Path(sys.argv[1])
for path in sorted(out.rglob("summary.json")):
    objects = [o for o in json.loads(path.read_text())["scene"]["objects"] if o["size"]]
    words = ", ".join("%s on %s" % (o["name"], o["parent"]) for o in objects)
    print(path.parent.relative_to(out), len(objects), words, sep="\t")
END
failed=$(find "$out" -name log.txt -execdir test ! -e summary.json ';' -print | wc -l)
if [ "$failed" -gt 0 ]; then
    echo "wrote $out/table.tsv; $failed failed, see log.txt in their folders"
    exit 1
fi
echo "wrote $out/table.tsv"
