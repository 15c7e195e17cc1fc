"""Positions latched by a PandABox: every sample once, and a clear word where there is none."""

import struct
import threading
import time

import numpy as np
import pytest

from omsm_ros.errors import ConfigurationError, DeviceError
from omsm_ros.instruments.factory import make_axes
from omsm_ros.instruments.parameters import AXIS_PARAMETERS, defaults
from omsm_ros.instruments.reader import DeviceReader
from omsm_ros.instruments.transport import transport_for

from .panda_server import Panda

pytest.importorskip("pandablocks", reason="pandablocks is an optional package")

PERIOD = 1e-3
LONG_S = 10.0


@pytest.fixture
def panda():
    made = Panda(PERIOD)
    yield made
    made.close()


def address(panda, fields="x=INENC1.VAL&z=INENC2.VAL&c=INENC3.VAL"):
    return f"panda://127.0.0.1:{panda.port}?{fields}"


@pytest.fixture(autouse=True)
def _closing():
    yield
    while MADE:
        MADE.pop().close()


MADE = []


def device_for(panda, fields="x=INENC1.VAL&z=INENC2.VAL&c=INENC3.VAL"):
    scales = {"x": 1e9, "y": 1.0, "z": 1e8, "b": 1.0, "c": 1e6}
    values = defaults(AXIS_PARAMETERS) | {"port": address(panda, fields), "block_size": 20}
    MADE.append(make_axes(values | {f"{axis}.counts_per_unit": n for axis, n in scales.items()}))
    return MADE[-1]


def poll_until(device, count, least_s=0.0):
    """Read until ``count`` samples were decoded since construction; return the blocks."""
    blocks, begin = [], time.monotonic()
    while device.decoded < count or time.monotonic() - begin < least_s:
        assert time.monotonic() - begin < LONG_S, device.decoded
        blocks += device.poll(0.02)
    return blocks


@pytest.fixture
def device(panda):
    made = device_for(panda)
    made.open()
    yield made
    made.close()


def axes_of(blocks, name):
    return np.concatenate([getattr(pair.axes, name) for pair in blocks])


def test_every_sample_comes_once_in_si(panda, device):
    for count in (7, 900, 45, 48):
        panda.trigger(count)
        time.sleep(0.01)
    blocks = [*poll_until(device, 1000), *device.close()]
    first = [(pair.axes.first_sample, len(pair.axes.x)) for pair in blocks]
    assert first == [(20 * i, 20) for i in range(50)]
    at = np.arange(1, 1001)
    assert axes_of(blocks, "x") == pytest.approx(10 * at * 1e-9, rel=1e-12)
    assert axes_of(blocks, "z") == pytest.approx((1000 - 20 * at) * 1e-8, rel=1e-12)
    assert axes_of(blocks, "c") == pytest.approx((2000 + 30 * at) * 1e-6, rel=1e-12)
    assert not axes_of(blocks, "y").any()
    counted = device.statistics
    assert (counted.delivered, counted.lost, counted.restarts) == (1000, 0, 0)
    assert abs(counted.period_deviation) < 1e-6


def test_scale_and_offset_of_the_web_page_change_no_position(panda):
    panda.scales["INENC1.VAL"] = (-2.5e-7, 12.5, "mm")
    panda.scales["INENC2.VAL"] = (0.123456789012, -3.0, "deg")
    device = device_for(panda)
    device.open()
    panda.trigger(40)
    blocks = [*poll_until(device, 40), *device.close()]
    assert axes_of(blocks, "x") == pytest.approx(10 * np.arange(1, 41) * 1e-9, rel=1e-12)
    assert axes_of(blocks, "z") == pytest.approx((1000 - 20 * np.arange(1, 41)) * 1e-8, rel=1e-12)


def test_a_scale_with_too_many_digits_is_reported(panda, device):
    panda.scales["INENC2.VAL"] = (1e-12, 1 / 3, "m")
    panda.trigger(5)
    with pytest.raises(DeviceError, match=r"INENC2\.VAL with SCALE 1e-12 and OFFSET 0\.33"):
        poll_until(device, 5)


def test_counts_of_32_bits_go_on_where_they_wrap(panda):
    panda.start[0] = 2**31 - 15
    device = device_for(panda)
    device.open()
    panda.trigger(40)
    blocks = [*poll_until(device, 40), *device.close()]
    assert np.diff(axes_of(blocks, "x")) == pytest.approx(10e-9)


@pytest.mark.parametrize("seconds", [0.25, 1.0])
def test_a_drop_of_the_line_costs_no_sample(panda, device, seconds):
    panda.trigger(300)
    blocks = poll_until(device, 300)
    mover = threading.Thread(target=lambda: panda.trigger(200))
    panda.unplug()
    mover.start()
    with pytest.raises(DeviceError, match="lost"):
        poll_until(device, 400)
    blocks += device.close()
    mover.join()
    time.sleep(seconds)
    panda.plug()
    device.open()
    panda.trigger(100)
    blocks += [*poll_until(device, 600), *device.close()]
    assert axes_of(blocks, "x") == pytest.approx(10 * np.arange(1, 601) * 1e-9)
    assert (device.statistics.lost, device.statistics.restarts) == (0, 0)
    assert device.statistics.delivered == 600


def test_what_the_box_no_longer_holds_is_a_gap(panda, device):
    panda.room = 50
    panda.trigger(30)
    poll_until(device, 30)
    panda.drop()
    panda.trigger(130)
    with pytest.raises(DeviceError):
        poll_until(device, 100)
    device.close()
    device.open()
    poll_until(device, 80)
    device.close()
    assert (device.statistics.lost, device.statistics.gaps) == (80, 1)


def test_a_capture_that_runs_already_is_joined_with_its_next_sample(panda):
    first = device_for(panda)
    first.open()
    panda.trigger(100)
    poll_until(first, 100)
    first.close()
    second = device_for(panda)
    second.open()
    panda.trigger(40)
    (block, *_) = [*poll_until(second, 40), *second.close()]
    assert block.axes.first_sample == 100
    assert second.statistics.decoded == 40


@pytest.mark.parametrize(
    ("reason", "remedy"),
    [
        ("Disarmed", "another program disarmed it"),
        ("Framing error", "triggers came too fast"),
        ("Driver data overrun", "overloaded"),
        ("DMA data error", "capture fewer fields"),
    ],
)
def test_a_capture_that_ends_is_one_error_with_its_remedy(panda, device, reason, remedy):
    panda.trigger(30)
    poll_until(device, 30)
    panda.trigger(10)
    panda.finish(reason)
    with pytest.raises(DeviceError, match=f"'{reason}': .*{remedy}"):
        poll_until(device, 100)
    assert device.statistics.decoded == 40
    device.close()
    device.open()
    panda.trigger(20)
    poll_until(device, 60)
    assert device.statistics.restarts == 1


def test_a_reader_that_is_too_slow_is_reported(panda, device):
    panda.room = 10
    panda.trigger(5)
    poll_until(device, 5)
    panda.trigger(100)
    with pytest.raises(DeviceError, match=r"'Data overrun': this computer"):
        poll_until(device, 1000)


def test_the_next_capture_begins_by_itself_when_the_enable_falls(panda, device):
    panda.trigger(30)
    poll_until(device, 30)
    panda.finish("Ok")
    while not panda.busy:
        device.poll(0.02)
    panda.trigger(30)
    poll_until(device, 60)
    assert (device.statistics.restarts, device.statistics.lost) == (1, 0)


def test_it_is_armed_once_the_last_capture_was_sent(panda, device):
    panda.trigger(30)
    poll_until(device, 30)
    panda.answers["*PCAP.ARM="] = "ERR Data clients still taking data"
    panda.finish("Ok")
    later = threading.Timer(0.1, panda.answers.clear)
    later.start()
    while not panda.busy:
        device.poll(0.02)
    later.join()
    panda.trigger(30)
    poll_until(device, 60)
    assert (device.statistics.restarts, device.statistics.lost) == (1, 0)


class Lateness(threading.Thread):
    """By how much a thread of this machine is late in all [s], so that its load is no fault."""

    def __init__(self):
        super().__init__(daemon=True)
        self.seconds, self.over = 0.0, threading.Event()

    def run(self):
        while not self.over.is_set():
            begin = time.monotonic()
            time.sleep(0.01)
            self.seconds += time.monotonic() - begin - 0.01

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.over.set()
        self.join()


@pytest.mark.parametrize("seconds", [0.0, 0.25, 1.0, 5.0])
def test_it_is_back_two_seconds_after_any_drop(panda, device, seconds):
    """The box keeps measuring, and its buffer holds what was latched meanwhile."""
    blocks, stop, over = [], threading.Event(), threading.Event()
    reader = DeviceReader(device, blocks.extend)
    device.close()
    threads = [threading.Thread(target=reader.run, args=(stop,))]
    threads.append(threading.Thread(target=trigger_evenly, args=(panda, over)))
    threads[0].start()
    try:
        wait_for(lambda: reader.connections == 1)
        threads[1].start()
        wait_for(lambda: device.decoded >= 300)
        panda.drop(seconds)
        back, before = time.monotonic(), device.decoded
        with Lateness() as late:
            wait_for(lambda: device.decoded > before and reader.connections == 2)
            took = time.monotonic() - back - late.seconds
        over.set()
        wait_for(lambda: device.decoded == panda.captured)
    finally:
        over.set()
        stop.set()
        for thread in threads:
            if thread.ident:
                thread.join()
    assert took <= 2.0
    found = device.statistics
    assert (found.lost, found.duplicates, found.restarts) == (0, 0, 0)
    assert found.decoded == found.delivered == panda.captured
    seen = np.concatenate([b.axes.first_sample + np.arange(len(b.axes.x)) for b in blocks])
    np.testing.assert_array_equal(seen, np.arange(panda.captured))


def trigger_evenly(panda, over):
    begin, done = time.monotonic(), 0
    while not over.wait(0.01):
        due = round((time.monotonic() - begin) / PERIOD)
        panda.trigger(due - done)
        done = due


@pytest.mark.parametrize("silently", [False, True])
def test_it_is_armed_again_after_a_power_cycle(panda, device, silently):
    notes, blocks, stop = [], [], threading.Event()
    reader = DeviceReader(device, blocks.extend, complain=notes.append)
    device.close()
    thread = threading.Thread(target=reader.run, args=(stop,))
    thread.start()
    try:
        wait_for(lambda: reader.connections == 1)
        panda.trigger(100)
        wait_for(lambda: device.decoded == 100)
        panda.forget() if silently else panda.power_cycle(0.3)
        back = time.monotonic()
        wait_for(lambda: panda.busy)
        took = time.monotonic() - back
        panda.trigger(60)
        wait_for(lambda: device.decoded == 160)
    finally:
        stop.set()
        thread.join()
    assert took < LONG_S
    assert device.statistics.restarts == 1
    assert 1 <= len(notes) <= 3


def wait_for(condition):
    begin = time.monotonic()
    while not condition():
        assert time.monotonic() - begin < LONG_S
        time.sleep(0.01)


def test_a_server_that_stalls_is_given_up_and_found_again(panda, device):
    panda.trigger(20)
    poll_until(device, 20)
    panda.stall(60.0)
    begin = time.monotonic()
    with pytest.raises(DeviceError, match="did not answer"):
        poll_until(device, 100)
    assert time.monotonic() - begin > 1.0
    device.close()
    panda.quiet_until = 0.0
    device.open()
    panda.trigger(20)
    poll_until(device, 40)
    assert device.statistics.lost == 0


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ("x=INENC9.VAL", r"INENC9\.VAL\.CAPTURE.*No such field"),
        ("x=INENCX1.VAL", r"INENCX1\.VAL\.CAPTURE.*No such block"),
    ],
)
def test_a_wrong_field_is_named(panda, fields, said):
    with pytest.raises(DeviceError, match=said) as found:
        device_for(panda, fields).open()
    assert len(str(found.value).splitlines()) == 1
    assert "AssertionError" not in str(found.value)


@pytest.mark.parametrize("field", ["PCAP.TRIG", "PCAP.ENABLE"])
def test_a_trigger_that_is_not_wired_is_reported(panda, field):
    panda.wiring[field] = "ZERO"
    with pytest.raises(DeviceError, match=f"{field} of the box is ZERO"):
        device_for(panda).open()


def test_a_running_capture_without_a_field_is_reported(panda):
    device_for(panda, "x=INENC1.VAL").open()
    panda.trigger(5)
    device = device_for(panda)
    device.open()
    with pytest.raises(DeviceError, match=r"has no \['INENC2\.VAL', 'INENC3\.VAL'\]"):
        poll_until(device, 5)


@pytest.mark.parametrize(
    "wrong",
    [
        b"HTTP/1.1 400 Bad Request\r\n" * 2000,
        b"x" * 200_000,
        b"<header>\n" + b"a\n" * 100_000,
        b"<header>\n<data/>\n</header>\n\n",
        b"<header>\n</header>\n\n",
        b"<header>\n<!DOCTYPE a [<!ENTITY b 'c'>]>\n</header>\n\n",
        "END",
        "BIN " + "\0" * 4,
        "BIN \4\0\0\0BIN ",
        "BIN \xff\xff\xff\xff",
        "BIN \x0b\0\0\0abc",
        "END x y\n",
        "END 7 Because\n",
        "END " + "9" * 200_000 + " Ok\n",
        "BIN \x28\0\0\0" + struct.pack("<4d", 1.0, np.nan, 3.0, 4.0).decode("latin1"),
        "BIN \x28\0\0\0" + struct.pack("<4d", 1.0, 2.0, 3.0, 1e300).decode("latin1"),
        'type="object"',
        'scale="0"',
        'scale="nan"',
        'missed="-1"',
        'missed="1e9"',
        'missed="99999999999999999999999"',
        'arm_time=""',
    ],
)
def test_what_no_server_sends_is_one_clear_line(panda, device, wrong):
    panda.trigger(1)
    poll_until(device, 1)
    device.close()
    panda.power_cycle()
    header = panda.header

    def sent(missed):
        usual = header(missed)
        if isinstance(wrong, bytes):
            return wrong
        if wrong.startswith(("END", "BIN")):
            return usual + wrong.encode("latin1")
        name = wrong.partition("=")[0].encode()
        before, _, after = usual.partition(name + b'="')
        return before + wrong.encode() + after.partition(b'"')[2]

    panda.header = sent
    device.open()
    panda.trigger(1 if wrong == "END" else 3)
    if wrong == "END":  # what follows makes no number of it
        panda.finish("Ok")
    with pytest.raises(
        DeviceError, match=r"sends what no|lost|ended|has no|no whole|of which \d+ came"
    ) as found:
        poll_until(device, 100)
    assert len(str(found.value).splitlines()) == 1


@pytest.mark.parametrize(
    "answer", ["", "OK", "OK =", "!x\n.", "!x\ny", ".", "\xff", "OK =1\nOK =2\nOK =3", "x" * 30_000]
)
@pytest.mark.parametrize("asked", ["*PCAP.COMPLETION?", "PCAP.TRIG?", "INENC1.VAL.CAPTURE=Value"])
def test_no_answer_of_a_server_is_a_defect(panda, asked, answer):
    panda.answers[asked] = answer
    found = []
    try:
        device_for(panda).open()
    except DeviceError as err:
        found = str(err).splitlines()
    assert len(found) <= 1


@pytest.mark.parametrize(
    "text",
    [
        "panda://h",
        "panda://?x=INENC1.VAL",
        "panda://h?q=INENC1.VAL",
        "panda://h?x=INENC1.VAL&x=INENC2.VAL",
        "panda://h?x=",
        "panda://h?x=INENC1.VAL%0a*PCAP.DISARM",
        "panda://h/y?x=INENC1.VAL",
        "panda://[::1?x=INENC1.VAL",
    ],
)
def test_an_address_that_is_none_is_refused(text):
    with pytest.raises(ConfigurationError, match=r"expected panda://|cannot be read"):
        transport_for(text)


def test_nobody_there_is_one_clear_line():
    box = transport_for("panda://127.0.0.1:1?x=INENC1.VAL")
    with pytest.raises(DeviceError, match="check address"):
        box.open()
