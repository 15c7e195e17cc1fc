"""LinuxCNC: each servo cycle of HAL's sampler, as ``config/linuxcnc/send.py`` sends it."""
