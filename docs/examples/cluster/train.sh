#!/bin/bash
# Train a run, or resume it if it exists; then evaluate it, export its policy, and pack it into one file:
# train.sh NAME [OVERRIDE ...]
set -euo pipefail
trap : TERM # Wait for the command that runs, which stops with a checkpoint and exit status 130.
name=$1
shift
find_run() { # Print runs/<task>/<date>_<time>_<seed>_<name>.
    for file in runs/*/*/manifest.json; do
        if [[ $file =~ /[0-9_-]{19}_[0-9]+_"$name"/manifest.json$ ]]; then echo "${file%/*}"; fi
    done
}

run=$(find_run)
if [ -z "$run" ]; then
    wheelleg train "run.name=$name" "$@"
    run=$(find_run)
elif [[ $run == *$'\n'* ]]; then
    echo "several runs are named $name; give another name or remove all but one:" "$run" >&2
    exit 2
elif ! grep -q '^  "status": "finished"' "$run/manifest.json"; then
    wheelleg resume "$run"
fi
wheelleg evaluate "$run" "protocol=${PROTOCOL:-stand}"
wheelleg export "$run" -o "$run/bundle"
tar --create --gzip --file "$name.tar.gz" "$run"
