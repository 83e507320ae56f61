#!/usr/bin/env bash
# Makes the page that tracks in a browser: build.sh [FOLDER], by default docs/try/site. Needs Rust
# with the target wasm32-unknown-unknown (rustup target add wasm32-unknown-unknown).
set -eu
cd "$(dirname "$0")/../.."
folder=${1:-docs/try/site}
target=${CARGO_TARGET_DIR:-$PWD/target/wasm}
# Settings of the target (128-bit vectors) are read from the folder in which cargo runs.
(cd crates/odograph-wasm && CARGO_TARGET_DIR="$target" cargo build --release --locked --target wasm32-unknown-unknown)
mkdir -p "$folder/sample"
cp docs/try/{index.html,try.css,app.js,worker.js,video.js} "$folder/"
cp crates/odograph-live/src/page/{style.css,icon.svg,map.js,track.js,camera.js} "$folder/"
cp crates/odograph-cli/demo/{drive.mp4,camera.yaml,rig.toml} "$folder/sample/"
cp "$target/wasm32-unknown-unknown/release/odograph.wasm" "$folder/"
echo "Made $folder ($(du -k "$folder/odograph.wasm" | cut -f1) kB of WebAssembly). To open it:"
echo "  python3 -m http.server --bind 127.0.0.1 -d $folder 8000    # http://127.0.0.1:8000/"
