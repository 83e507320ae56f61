#!/usr/bin/env bash
# Memory, latency and dropped frames of `odograph live` over a long time: the bundled drive over and over, through a pipe.
#
#   bench/live.sh SECONDS [RATE] [PROGRAM]
#
# RATE 1 is the drive's own 30 frames a second; 0 is as fast as ffmpeg can write, which is more than tracking takes. Needs ffmpeg and curl. Prints every half minute: seconds, resident memory (kB), frames captured and dropped, latency median and 99th percentile (ms), metres.
set -eu -o pipefail
seconds=$1
rate=${2:-1}
program=${3:-$(dirname "$0")/../target/release/odograph}
demo=$(dirname "$0")/../crates/odograph-cli/demo
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
pace=()
[ "$rate" = 0 ] || pace=(-readrate "$rate")
mkfifo "$folder/frames"
timeout "$seconds" ffmpeg -nostdin -v error "${pace[@]}" -stream_loop -1 -i "$demo/drive.mp4" -f yuv4mpegpipe -y "$folder/frames" &
"$program" live - --camera "$demo/camera.yaml" --rig "$demo/rig.toml" --serve 127.0.0.1:0 -o "$folder/run" \
    <"$folder/frames" >/dev/null 2>"$folder/told" &
process=$!
until url=$(grep -o 'http://[^ ]*' "$folder/told" 2>/dev/null); do sleep 0.2; done
begun=$SECONDS
while kill -0 "$process" 2>/dev/null; do
    memory=$(awk '/VmRSS/ { print $2 }' "/proc/$process/status" 2>/dev/null || true)
    figures=$(curl -s -m 5 "${url}state" | grep -o '"\(captured\|dropped\|latency_median_ms\|latency_p99_ms\|distance_m\)":[0-9.]*' | tr '\n' ' ' || true)
    echo "$((SECONDS - begun)) s  ${memory} kB  $figures"
    for _ in $(seq 30); do kill -0 "$process" 2>/dev/null && sleep 1; done
done
wait "$process" || true
sed -n '/"live"/,/}/p' "$folder/run/stats.json"
