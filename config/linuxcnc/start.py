#!/usr/bin/env python3
"""Run a G-code program on LinuxCNC without hardware: home, run, end.

    python3 start.py PROGRAM.nc --port 7010 [--cycle 0.001] [--servo 200]

Each servo cycle is sent to PORT, for `omsm record` and `axis_driver`. LinuxCNC refuses to run as
root; started by root it runs as the user nobody. The largest acceleration of C is that which the
program states in its comment. Only one LinuxCNC runs on a computer; processes and shared memory
that a killed run of this script left behind are removed at the next start.
"""

import argparse
import contextlib
import fcntl
import math
import os
import pwd
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

INSTALL = "apt-get install -y --no-install-recommends linuxcnc-uspace"
HERE = Path(__file__).resolve().parent
OTHER_USER = "nobody"
END_S = 10.0
# An earlier run waits half a minute for a reader of its last samples before it ends.
BEFORE_S = 60.0
# Marks the processes of this script; LinuxCNC hands its environment on to all of them.
MARK = "OMSM_PROGRAM"
# Processes of any LinuxCNC: realtime, and the owner of its shared memory.
PROCESSES = ("rtapi_app", "linuxcncsvr")
# Keys of that shared memory: messages, motion, RTAPI, HAL, sampler.
SEGMENTS = (1001, 1002, 1003, 1004, 1005, 100, 0x48484C34, 0x48414C32, 0x48534130)
LOCK = Path("/tmp/linuxcnc.lock")
# The last that run.py says.
DONE = "program done"


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


def processes():
    """Return the processes of this script's LinuxCNC, and those of another one."""
    own, other = [], []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            name, marked = (folder / "comm").read_text().strip(), False
            if "Z" in (folder / "stat").read_text().rpartition(")")[2].split()[0]:
                continue
            with contextlib.suppress(PermissionError):
                marked = f"{MARK}=".encode() in (folder / "environ").read_bytes()
            if marked:
                own.append(int(folder.name))
            elif name in PROCESSES:
                other.append(int(folder.name))
    return own, other


def clear():
    """Kill what an earlier run left, remove its shared memory; RuntimeError if another one runs."""
    end = time.monotonic() + END_S
    while found := processes():
        own, other = found
        if other:
            numbers = " ".join(map(str, other))
            raise RuntimeError(f"another LinuxCNC is running; end it first (kill -9 {numbers})")
        if not own:
            break
        if time.monotonic() > end:
            raise RuntimeError(f"processes {own} of an earlier LinuxCNC do not end")
        for number in own:
            with contextlib.suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        time.sleep(0.05)
    lines = Path("/proc/sysvipc/shm").read_text().splitlines()[1:]
    left = [words for line in lines if int((words := line.split())[0]) % 2**32 in SEGMENTS]
    for words in left:
        subprocess.run(["ipcrm", "-m", words[1]], check=False)
    LOCK.unlink(missing_ok=True)


@contextlib.contextmanager
def alone():
    """Lock LinuxCNC for this process; RuntimeError if another run of this script does not end."""
    with Path(shutil.which("linuxcnc")).open() as locked:
        end = time.monotonic() + BEFORE_S
        while True:
            try:
                fcntl.flock(locked, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as err:
                if time.monotonic() > end:
                    raise RuntimeError(
                        "this script runs LinuxCNC already; wait until it has ended"
                    ) from err
                time.sleep(0.2)
        clear()
        try:
            yield
        finally:
            clear()


@contextlib.contextmanager
def running(program, port, cycle=1e-3, servo=200.0):
    """Start LinuxCNC with the text of a program; yield its process, and end it."""
    if reason := missing():
        raise RuntimeError(reason)
    with alone(), tempfile.TemporaryDirectory(prefix="linuxcnc_") as name:
        folder = Path(name)
        configure(folder, program, port, cycle, servo)
        environment = os.environ | {"HOME": name, MARK: str(folder / "program.nc")}
        environment.pop("PYTHONPATH", None)  # its Python is that of the system
        other = {}
        if os.geteuid() == 0:
            for path in (folder, *folder.iterdir()):
                shutil.chown(path, OTHER_USER)
            user = pwd.getpwnam(OTHER_USER)
            other = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": ()}
        said = folder / "said.txt"
        with said.open("w") as log:
            process = subprocess.Popen(
                ["linuxcnc", "-r", str(folder / "cell.ini")],
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                **other,
            )
        try:
            yield process
        finally:
            if process.poll() is not None and DONE not in (text := said.read_text()):
                print(f"LinuxCNC ended early ({process.returncode}): {text}", file=sys.stderr)
            # Asked to end, LinuxCNC ends its own processes; what then remains is cleared.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


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
