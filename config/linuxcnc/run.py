#!/usr/bin/python3
"""Run a program on LinuxCNC without a display: home, run, end. Started by LinuxCNC ([DISPLAY])."""

import os
import sys
import time

import linuxcnc

command, status = linuxcnc.command(), linuxcnc.stat()
errors = linuxcnc.error_channel()


def until(reached, patience):
    end = time.monotonic() + patience
    status.poll()
    while not reached():
        if found := errors.poll():
            sys.exit(f"LinuxCNC: {found[1]}")
        if time.monotonic() > end:
            sys.exit("LinuxCNC did not answer in time")
        time.sleep(0.05)
        status.poll()


command.state(linuxcnc.STATE_ESTOP_RESET)
command.wait_complete()
command.state(linuxcnc.STATE_ON)
until(lambda: status.task_state == linuxcnc.STATE_ON, 5)
command.mode(linuxcnc.MODE_MANUAL)
command.wait_complete()
for joint in range(status.joints):
    command.home(joint)
    until(lambda joint=joint: status.homed[joint], 10)
command.mode(linuxcnc.MODE_AUTO)
command.wait_complete()
command.program_open(os.environ["OMSM_PROGRAM"])
command.auto(linuxcnc.AUTO_RUN, 0)
time.sleep(0.5)
until(
    lambda: (
        status.interp_state == linuxcnc.INTERP_IDLE
        and status.exec_state == linuxcnc.EXEC_DONE
        and status.queue == 0
        and status.inpos
    ),
    1e6,
)
print("program done", flush=True)
# The last lines of the sampler are still on their way.
time.sleep(0.5)
