#!/bin/bash
# Train a run, or resume it if it exists; then evaluate it, export its policy, and pack it into one file:
# train.sh NAME [OVERRIDE ...]
set -euo pipefail
trap : TERM # Wait for the command that runs, which stops with a checkpoint and exit status 130.
name=$1
shift
find_run() { find runs -mindepth 3 -maxdepth 3 -path "*_$name/manifest.json" -printf '%h\n'; }

mkdir -p runs
if [ -z "$(find_run)" ]; then
    wheelleg train "run.name=$name" "$@"
elif ! grep -q '^  "status": "finished"' "$(find_run)/manifest.json"; then
    wheelleg resume "$(find_run)"
fi
run=$(find_run)
wheelleg evaluate "$run" "protocol=${PROTOCOL:-stand}"
wheelleg export "$run" -o "$run/bundle"
tar --create --gzip --file "$name.tar.gz" "$run"
