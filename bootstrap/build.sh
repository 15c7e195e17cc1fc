#!/bin/sh
# bootstrap/build.sh PACKAGE…: build packages of the workspace into install/.
set -eu
cd "$(dirname "$0")/.."
. ./env.sh
export COLCON_DEFAULTS_FILE="$PWD/colcon_defaults.yaml"
# `python -m colcon`, not `colcon`: a distribution's own would write scripts that start the
# system's Python, which does not see .venv. Its warnings are about wheels in general: that .venv
# has no local_setup.sh.
python -m colcon --log-level error build --packages-select "$@"
