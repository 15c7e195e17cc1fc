"""Elapsed time of long commands on a terminal."""

import io
import sys
import time

import pytest

from omsm_ros.cli import command_line as module
from omsm_ros.cli.command_line import progress_in_background
from omsm_ros.pipelines import progress

LINE = "omsm form: 00:00 so far"


class Terminal(io.StringIO):
    tty = True

    def isatty(self):
        return self.tty

    def pending_listeners(self, text, seconds=20.0):
        end = time.monotonic() + seconds
        while text not in self.getvalue() and time.monotonic() < end:
            time.sleep(0.01)
        return text in self.getvalue()


@pytest.fixture
def terminal(monkeypatch):
    """Return a function that sets a terminal as stderr, as pytest resets it before each test."""

    def made(patience=0.02):
        monkeypatch.setattr(sys, "stderr", Terminal())
        monkeypatch.setattr(module, "_DELAY_S", patience)
        monkeypatch.setattr(progress, "_TICK_S", 0.01)
        return sys.stderr

    return made


def test_long_work_counts_its_seconds_and_leaves_nothing_behind(terminal):
    stderr = terminal()
    with progress_in_background("omsm form", quiet=False):
        assert stderr.pending_listeners(LINE)
    assert stderr.getvalue().endswith("\r")
    assert stderr.getvalue().split("\r")[-2].strip() == ""


def test_stated_progress_stands_in_the_line(terminal):
    stderr = terminal()
    with progress_in_background("omsm form", quiet=False):
        progress.state_progress(30, 0)
        assert stderr.pending_listeners("omsm form: 30 done, 00:00 so far")
        progress.state_progress(30, 120)
        assert stderr.pending_listeners("omsm form:  25 % |")
        progress.state_progress(120, 120)
        assert stderr.pending_listeners("omsm form: 120 done, ")


def test_a_fault_finds_the_line_gone(terminal):
    stderr = terminal()

    def fails():
        with progress_in_background("omsm form", quiet=False):
            assert stderr.pending_listeners(LINE)
            raise ValueError("wrong")

    with pytest.raises(ValueError, match="wrong"):
        fails()
    assert stderr.getvalue().split("\r")[-2].strip() == ""


def test_short_work_programs_and_pipes_see_nothing(terminal):
    stderr = terminal(patience=1000.0)
    with progress_in_background("omsm form", quiet=False):
        pass
    assert stderr.getvalue() == ""
    stderr = terminal()
    with progress_in_background("omsm form", quiet=True):
        assert not stderr.pending_listeners(LINE, 0.1)
    stderr.tty = False
    with progress_in_background("omsm form", quiet=False):
        assert not stderr.pending_listeners(LINE, 0.1)
