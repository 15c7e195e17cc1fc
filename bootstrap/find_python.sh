#!/bin/sh
# Print a Python for the workspace (PYTHON, or the first suited one on PATH), or say what is missing.
here=$(dirname "$0")
versions=
distribution=$("$here/distribution.sh")
if [ -n "$distribution" ]; then # compiled modules fit one version only
    versions=$(basename "$distribution"/lib/python3.*)
    versions=${versions#python}
fi

for candidate in ${PYTHON:-python3 python3.12 python3.11 python3.13 python3.10}; do
    # A name on PATH may be a version manager's stub that only prints an error: then it is no Python.
    "$candidate" -c "" 2>/dev/null || continue
    if said=$("$candidate" "$here/check_python.py" $versions 2>&1); then
        echo "$said"
        exit
    fi
    first=${first:-$said}
done
echo "setup: ${first:-${PYTHON:-python3} not found: sudo apt install python3-venv python3-dev}" >&2
exit 1
