#!/bin/sh
# bootstrap/matrix.sh [GOAL]: `make GOAL` (test) in a copy of this tree, for each Python from 3.10 to
# 3.13 that is installed. One lock.txt serves them all: it was resolved for every one of them.
set -eu
cd "$(dirname "$0")/.."
goal=${1:-test}
tried= failed=
for version in 3.10 3.11 3.12 3.13; do
    python=$(command -v "python$version") || python=
    # A name on PATH may be a version manager's stub that only prints an error.
    if [ -z "$python" ] || ! "$python" -c "" 2>/dev/null; then
        echo "matrix: Python $version is not installed: skipped"
        continue
    fi
    place=out/matrix/$version
    mkdir -p "$place"
    # What is tracked, as it stands now; .venv, build and install of an earlier run stay there.
    git ls-files -z | xargs -0 cp --parents --no-dereference --preserve=timestamps -t "$place" --
    echo "matrix: make $goal with Python $version in $place"
    if make -C "$place" PYTHON="$python" "$goal"; then
        tried="$tried $version"
    else
        failed="$failed $version"
    fi
done
echo "matrix: passed:${tried:- none}; failed:${failed:- none}"
[ -z "$failed" ]
