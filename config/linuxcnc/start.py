#!/usr/bin/env python3
"""Run a G-code program on LinuxCNC without hardware: home, run, end.

    python3 start.py PROGRAM.nc --port 7010 [--cycle 0.001] [--servo 200]

Each servo cycle is sent to PORT, for `omsm record` and `axis_driver`. LinuxCNC refuses to run as
root; started by root it runs as the user nobody. The largest acceleration of C is that which the
program states in its comment. Only one LinuxCNC runs on a computer.
"""

import argparse
import contextlib
import math
import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

INSTALL = "apt-get install -y --no-install-recommends linuxcnc-uspace"
HERE = Path(__file__).resolve().parent
OTHER_USER = "nobody"
END_S = 10.0


def missing():
    """Return why LinuxCNC cannot be run here, with the remedy; empty if it can."""
    if shutil.which("linuxcnc"):
        return ""
    return f"LinuxCNC is not installed; on Debian 12: {INSTALL}"


def configure(folder, program, port, cycle, servo):
    """Copy the configuration into ``folder``, with what this run needs."""
    for path in HERE.iterdir():
        if path.is_file():
            shutil.copy(path, folder)
    for script in ("run.py", "send.py"):
        (folder / script).chmod(0o755)
    (folder / "program.nc").write_text(program)
    ini, hal = folder / "cell.ini", folder / "cell.hal"
    text = ini.read_text().replace("SERVO_PERIOD = 1000000", f"SERVO_PERIOD = {cycle * 1e9:.0f}")
    if found := re.search(r"largest acceleration to (\d+) deg/s2", program):
        text = text.replace("MAX_ACCELERATION = 180180", f"MAX_ACCELERATION = {found[1]}")
    ini.write_text(text)
    gain = 1 - math.exp(-2 * math.pi * servo * cycle)
    text = hal.read_text().replace("gain 0.7154", f"gain {gain:.6f}")
    hal.write_text(text.replace("7010", str(port)))


@contextlib.contextmanager
def running(program, port, cycle=1e-3, servo=200.0):
    """Start LinuxCNC with the text of a program; yield its process, and end it."""
    if reason := missing():
        raise RuntimeError(reason)
    with tempfile.TemporaryDirectory(prefix="linuxcnc_") as name:
        folder = Path(name)
        configure(folder, program, port, cycle, servo)
        environment = os.environ | {"HOME": name, "OMSM_PROGRAM": str(folder / "program.nc")}
        environment.pop("PYTHONPATH", None)  # its Python is that of the system
        other = {}
        if os.geteuid() == 0:
            for path in (folder, *folder.iterdir()):
                shutil.chown(path, OTHER_USER)
            user = pwd.getpwnam(OTHER_USER)
            other = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": ()}
        process = subprocess.Popen(
            ["linuxcnc", str(folder / "cell.ini")],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
            **other,
        )
        try:
            yield process
        finally:
            end(process)


def end(process):
    """End LinuxCNC; it ends its own processes when it is asked to."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with contextlib.suppress(ProcessLookupError):
            if process.poll() is None:
                os.killpg(process.pid, number)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(END_S)
            return


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("program", type=Path)
    parser.add_argument("--port", type=int, default=7010)
    parser.add_argument("--cycle", type=float, default=1e-3, help="of the servo [s]")
    parser.add_argument("--servo", type=float, default=200.0, help="bandwidth [Hz]")
    args = parser.parse_args()
    try:
        with running(args.program.read_text(), args.port, args.cycle, args.servo) as linuxcnc:
            sys.exit(linuxcnc.wait())
    except (RuntimeError, OSError) as err:
        sys.exit(str(err))
