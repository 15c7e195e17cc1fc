#!/bin/sh
# bootstrap/build.sh PACKAGE: build one package of the workspace into install/.
set -eu
cd "$(dirname "$0")/.."
. ./env.sh
export COLCON_DEFAULTS_FILE="$PWD/colcon_defaults.yaml"
# `python -m colcon`, not `colcon`: a distribution's own colcon would write scripts that start the
# system's Python, which does not see .venv. And of its warnings, one is about wheels in general
# (no local_setup.sh in .venv).
python -m colcon --log-level error build --packages-select "$1"
