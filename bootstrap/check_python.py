"""Print the path of this Python if it can carry the workspace; else say what to install.

Runs on whatever Python is found, so it keeps to what Python 2 understands, too.
"""

import os
import platform
import sys

FROM_WHEELS = len(sys.argv) == 1  # else: the version that the sourced distribution was built for
VERSIONS = ["3.10", "3.11", "3.12", "3.13"] if FROM_WHEELS else sys.argv[1:]
NAME = "python%d.%d" % sys.version_info[:2]


def problem():
    if NAME[6:] not in VERSIONS:
        return "this is Python %s, needed is %s: install one, or give PYTHON=/path/to/python3" % (
            NAME[6:],
            " or ".join(VERSIONS),
        )
    try:
        import ensurepip  # noqa: F401  (Debian and Ubuntu package it separately)
        import venv  # noqa: F401
    except ImportError:
        return "it has no venv module: sudo apt install %s-venv" % NAME
    import sysconfig

    if not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")):
        return "it has no C headers: sudo apt install %s-dev" % NAME
    if FROM_WHEELS and platform.machine() != "x86_64":
        return "ROS 2 wheels exist for x86_64 only: install ROS 2 Jazzy and source its setup.sh"
    return None


if problem():
    sys.exit("%s: %s" % (sys.executable, problem()))
# Inside a venv, the Python it was made from: the venv may be the one that is about to be remade.
print(getattr(sys, "_base_executable", sys.executable))
