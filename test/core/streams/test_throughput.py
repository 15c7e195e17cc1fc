import pytest

from omsm_ros.core.streams.monitoring import LoadMeter


def test_latency_and_share():
    meter = LoadMeter()
    for late_ms in range(1, 101):
        meter.block(1_000, 1_000 + late_ms * 1_000_000)
    assert meter.report(0.0, 10.0)["cpu_share"] == 0.0
    report = meter.report(0.5, 12.0)
    assert report["cpu_share"] == 0.25
    assert report["latency_median_ms"] == pytest.approx(50.5)
    assert report["latency_p99_ms"] == pytest.approx(99.01)
    assert report["latency_max_ms"] == 100.0


def test_only_the_last_blocks_count():
    meter = LoadMeter(window=10)
    meter.block(0, 10**12)
    for _ in range(10):
        meter.block(0, 2_000_000)
    assert meter.report(0.0, 1.0)["latency_max_ms"] == 2.0


def test_without_blocks_there_is_no_latency():
    assert LoadMeter().report(0.0, 0.0) == {"cpu_share": 0.0}
