"""A TCP connection on this machine that breaks on demand, between a driver and its device."""

import socket
import threading
import time
from contextlib import suppress


class BrokenWire:
    """Passes bytes both ways; a context manager. ``port`` is what the driver connects to.

    vanish: both ends stay connected, and nothing that is sent arrives
    """

    def __init__(self, device_port):
        self._device_port = device_port
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self.connections = 0
        self._vanished, self._ended = threading.Event(), threading.Event()
        self._noise = b""
        self._ends, self._threads = [], []

    def __enter__(self):
        self._start(self._accept)
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._listening.shutdown(socket.SHUT_RDWR)
        self._threads[0].join()
        self._listening.close()
        self.cut()
        for thread in self._threads:
            thread.join()

    def vanish(self):
        self._vanished.set()

    def come_back(self):
        self._vanished.clear()

    def cut(self):
        """End the connections; the next one is let through."""
        while self._ends:
            with suppress(OSError):
                self._ends.pop().shutdown(socket.SHUT_RDWR)

    def disturb(self, noise):
        """Put ``noise`` before what the device sends next."""
        self._noise = noise

    def _accept(self):
        while not self._ended.is_set():
            with suppress(OSError):
                self._connect(self._listening.accept()[0])

    def _connect(self, driver):
        while self._vanished.is_set() and not self._ended.is_set():
            time.sleep(0.05)
        try:
            device = socket.create_connection(("127.0.0.1", self._device_port))
        except OSError:
            driver.close()
            return
        self.connections += 1
        self._ends += [driver, device]
        self._start(self._pass_on, driver, device, False)
        self._start(self._pass_on, device, driver, True)

    def _start(self, work, *arguments):
        self._threads.append(threading.Thread(target=work, args=arguments, daemon=True))
        self._threads[-1].start()

    def _pass_on(self, source, sink, from_device):
        with source, suppress(OSError):
            while data := source.recv(65536):
                if self._vanished.is_set():
                    continue
                if from_device and self._noise:
                    data, self._noise = self._noise + data, b""
                sink.sendall(data)
        with suppress(OSError):
            sink.shutdown(socket.SHUT_RDWR)
