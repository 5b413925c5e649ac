#!/bin/sh
# Make the frames in data/frames: scenes that derender drew, seen by simulated depth cameras.
set -eu
cd "$(dirname "$0")/.."
frames=data/frames
made=$(mktemp -d)
trap 'rm -rf "$made"' EXIT

printf '{"fx": 290.0, "fy": 290.0, "cx": 159.5, "cy": 119.5, "width": 320, "height": 240, "depth_scale": 1.0}\n' \
    >"$frames/kinect_camera.json"
printf '{"fx": 308.0, "fy": 308.0, "cx": 160.2, "cy": 118.7, "width": 320, "height": 240, "depth_scale": 0.1}\n' \
    >"$frames/realsense_camera.json"

derender sample tabletop --seed 6 --no-images --camera "$frames/kinect_camera.json" -o "$made"
mv "$made/sample_000.yaml" "$frames/kinect_tabletop.yaml"
derender render "$frames/kinect_tabletop.yaml" --sensor kinect --seed 1 -o "$frames/kinect_tabletop.png"

derender render "$frames/kinect_breakfast.yaml" --sensor kinect --seed 2 -o "$frames/kinect_breakfast.png"

derender sample two-stacks --seed 3 --no-images --camera "$frames/realsense_camera.json" -o "$made"
mv "$made/sample_000.yaml" "$frames/realsense_two_stacks.yaml"
derender render "$frames/realsense_two_stacks.yaml" --sensor realsense --seed 3 -o "$frames/realsense_two_stacks.png"
