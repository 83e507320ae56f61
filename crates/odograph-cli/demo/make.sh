#!/bin/sh
# Makes the demo clip again: renders the drive with `odograph simulate` and encodes it with ffmpeg.
#
#   demo/make.sh FOLDER_WITH_PHOTOGRAPHS [FOLDER_FOR_SCRATCH]
#
# The photographs, bricks.jpg and grass_dry.png, are named with their origin and checksum in README.md beside this script.
set -eu

demo=$(cd "$(dirname "$0")" && pwd)
photographs=$(cd "$1" && pwd)
scratch=${2:-$(mktemp -d)}
mkdir -p "$scratch"
scratch=$(cd "$scratch" && pwd)

(cd "$photographs" && sha256sum --check --quiet - <<SUMS
b49b0ab13aa4455cc7348cb4bfbbffcb344f2f81b17121eb1e57bcd3b387febe  bricks.jpg
8b82250dcd13860a468418116f941bccc49b6e5edd05be5fc85258407d3ad983  grass_dry.png
SUMS
)

cargo build --release --manifest-path "$demo/../Cargo.toml"
target=$(cargo metadata --manifest-path "$demo/../Cargo.toml" --format-version 1 --no-deps |
    sed 's/.*"target_directory":"\([^"]*\)".*/\1/')

(cd "$photographs" && "$target/release/odograph" simulate --output "$scratch" --force --color \
    --path eight --length 4.2 --speed 0.36 --seed 7 \
    --height 0.9 --roll 1.5 --pitch -3 \
    --texture bricks.jpg --photo-width 1.6 --tiling repeat \
    --texture grass_dry.png --photo-width 1.0 --tiling scatter \
    --vibration 3:0.6:5 --blur 0.01 --noise 1.5 --vignetting 0.35 --lighting 0.06)

# Two passes, so that the clip is as large as it may be and no larger; one thread, so that it comes out the same everywhere.
encode() {
    ffmpeg -v error -y -framerate 30 -i "$scratch/frames/%06d.png" \
        -c:v libx264 -profile:v high -preset slow -bf 3 -g 250 -b:v 800k -pix_fmt yuv420p -threads 1 -an \
        -pass "$1" -passlogfile "$scratch/x264" -movflags +faststart -fflags +bitexact -flags:v +bitexact -f mp4 "$2"
}
encode 1 /dev/null
encode 2 "$demo/drive.mp4"
cp "$scratch/camera.yaml" "$scratch/rig.toml" "$scratch/truth.tum" "$demo/"
