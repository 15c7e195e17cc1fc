#!/usr/bin/python3
"""Send HAL's sampler over TCP, a line a servo cycle: python3 send.py PORT CFG (cfg of the sampler).

Samples wait in the sampler's FIFO without a client; one that returns in time loses nothing.
"""

import socket
import sys
import time

import hal

# The port opens before this component is reported as ready: without it LinuxCNC does not start.
server = socket.create_server(("127.0.0.1", int(sys.argv[1])))
component = hal.component(f"send-{sys.argv[1]}")
component.ready()
stream = None


def gone(client):
    """Return whether the client has closed its connection, before samples are sent there."""
    try:
        return not client.recv(1, socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False


while True:
    client, _ = server.accept()
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    stream = stream or hal.stream(component, hal.sampler_base, sys.argv[2])
    overruns = stream.num_overruns
    try:
        while not gone(client):
            lines = []
            while stream.readable and len(lines) < 1000:
                lines.append(" ".join(f"{float(value):.17g}" for value in stream.read()) + "\n")
            if stream.num_overruns != overruns:
                overruns = stream.num_overruns
                lines.append("overrun\n")
            client.sendall("".join(lines).encode())
            time.sleep(0.02)
    except OSError:
        pass
    client.close()
