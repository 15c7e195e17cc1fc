#!/bin/sh
# Choose anew every version that is not fixed in a *.in file, for all Python versions at once.
set -eu
cd "$(dirname "$0")"
python3 -m venv "${TMPDIR:-/tmp}/omsm-lock"
"${TMPDIR:-/tmp}/omsm-lock/bin/pip" install --quiet uv
"${TMPDIR:-/tmp}/omsm-lock/bin/uv" --native-tls pip compile --quiet --universal --upgrade \
    --python-version 3.10 --no-annotate --custom-compile-command bootstrap/lock.sh \
    *.in --output-file lock.txt
