#!/usr/bin/python3
"""Run a program on LinuxCNC without a display: home, run, end. Started by LinuxCNC ([DISPLAY])."""

import os
import subprocess
import sys
import time

import linuxcnc

command, status = linuxcnc.command(), linuxcnc.stat()
errors = linuxcnc.error_channel()


def until(what, reached, patience=60.0):
    end = time.monotonic() + patience
    while True:
        try:
            status.poll()
        except linuxcnc.error as err:  # its task has not begun
            found = err
        else:
            if reached():
                return
            found = errors.poll()
            # It also hands on messages to the operator.
            if found and found[0] in (linuxcnc.NML_ERROR, linuxcnc.OPERATOR_ERROR):
                sys.exit(f"LinuxCNC, {what}: {found[1]}")
        if time.monotonic() > end:
            sys.exit(f"LinuxCNC, {what}: no answer in time {found or ''}")
        time.sleep(0.05)


def waiting():
    """Return the number of samples that are not sent."""
    depth = ["halcmd", "getp", "sampler.0.curr-depth"]
    return int(subprocess.run(depth, capture_output=True, check=True).stdout)


until("start", lambda: status.task_state >= linuxcnc.STATE_ESTOP)
command.state(linuxcnc.STATE_ESTOP_RESET)
command.wait_complete()
command.state(linuxcnc.STATE_ON)
until("on", lambda: status.task_state == linuxcnc.STATE_ON)
command.mode(linuxcnc.MODE_MANUAL)
command.wait_complete()
for joint in range(status.joints):
    command.home(joint)
    until("homing", lambda joint=joint: status.homed[joint])
command.mode(linuxcnc.MODE_AUTO)
command.wait_complete()
command.program_open(os.environ["OMSM_PROGRAM"])
command.auto(linuxcnc.AUTO_RUN, 0)
until("begin of the program", lambda: status.interp_state != linuxcnc.INTERP_IDLE)
until(
    "program",
    lambda: (
        status.interp_state == linuxcnc.INTERP_IDLE
        and status.exec_state == linuxcnc.EXEC_DONE
        and status.queue == 0
        and status.inpos
    ),
    1e6,
)
# A reader that came late takes what waits in the sampler; the last lines are still on their way.
until("samples that nobody reads", lambda: waiting() < 200, 30.0)
time.sleep(0.5)
print("program done", flush=True)
