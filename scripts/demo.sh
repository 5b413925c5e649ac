#!/bin/sh
# Turn one depth image into a scene graph, and say where everything is.
# Usage: scripts/demo.sh FOLDER [IMAGE [CAMERA]]        without IMAGE a scene is sampled and inferred back
set -eu
folder=$1
image=${2:-}
camera=${3:-}

run() {
    printf '\n$ derender %s\n' "$*"
    derender "$@"
}

mkdir -p "$folder"
if [ -z "$image" ]; then
    run sample --seed 6 -o "$folder"
    run render "$folder/sample_000.yaml" --preview -o "$folder/truth.png"
    image=$folder/sample_000.npz
fi
if [ -n "$camera" ]; then
    run infer "$image" --camera "$camera" --seed 1 -o "$folder/result"
else
    run infer "$image" --seed 1 -o "$folder/result"
fi
run render "$folder/result/scene.yaml" --preview -o "$folder/inferred.png"
run show "$folder/result"
run simulate "$folder/result"
if [ -f "$folder/sample_000.yaml" ] && [ "$image" = "$folder/sample_000.npz" ]; then
    run eval "$folder/result" "$folder/sample_000.yaml"
    printf '\nThe sampled scene:   %s\n' "$folder/truth.png"
fi
printf 'The inferred scene:  %s\n' "$folder/inferred.png"
printf 'The report to open:  %s\n' "$folder/result/report.html"
