#!/bin/sh
# Choose anew every version that is not fixed in a *.in file, for all Python versions at once.
set -eu
cd "$(dirname "$0")"
tools=$(mktemp -d)
trap 'rm -rf "$tools"' EXIT
python3 -m venv "$tools"
"$tools/bin/pip" install --quiet --disable-pip-version-check uv
"$tools/bin/uv" --native-tls pip compile --quiet --universal --upgrade --generate-hashes \
    --python-version 3.10 --no-annotate --custom-compile-command bootstrap/lock.sh *.in --output-file lock.txt
