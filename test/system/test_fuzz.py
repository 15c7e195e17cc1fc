"""Messages and requests that nobody meant, against nodes that run: none ends, stalls, or lies."""

import array

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omsm_msgs.msg import AxisBlock, Calibration, DistanceBlock
from omsm_msgs.srv import Identify, LoadCalibration, PredictError
from soaked import soaked

from omsm_ros.io import message_mapping
from omsm_ros.io.calibration_file import save_calibration
from omsm_ros.nodes.topics import LATCHED_QOS

pytestmark = pytest.mark.timeout(0)

NUMBERS = st.one_of(
    st.sampled_from([0.0, -0.0, 1e-3, 1.0, -1.0, 1e300, -1e300, 5e-324, float("inf")]), st.floats()
)
COUNTS = st.one_of(st.sampled_from([0, 1, 2**32, 2**53, 2**63, 2**64 - 1]), st.integers(0, 5000))
PERIODS = st.one_of(st.just(1e-3), st.just(1e-3), NUMBERS)
TEXTS = st.one_of(
    st.sampled_from(
        [
            "",
            "{}",
            "[]",
            "null",
            "NaN",
            "{",
            '{"verdict": 5}',
            '{"verdict": "accepted"}',
            "[" * 5000,
        ]
    ),
    st.text(st.characters(blacklist_categories=["Cs"], blacklist_characters="\0"), max_size=300),
)
PATHS = st.one_of(
    st.sampled_from(
        ["", ".", "/", "/dev/zero", "/dev/tty", "/etc", "n" * 300, "~", "../..", "x.mcap"]
    ),
    TEXTS,
)


def doubles(most):
    return st.lists(NUMBERS, max_size=most).map(lambda values: array.array("d", values))


def blocks():
    """One length for all channels, most of the time: then more of the node is reached."""
    length = st.integers(0, 30)

    def axes(n):
        same = st.lists(NUMBERS, min_size=n, max_size=n).map(lambda v: array.array("d", v))
        return st.fixed_dictionaries({c: st.one_of(same, same, doubles(5)) for c in "xyzbc"})

    def distance(n):
        same = st.lists(NUMBERS, min_size=n, max_size=n).map(lambda v: array.array("d", v))
        status = st.one_of(
            st.just([]), st.lists(st.integers(0, 255), min_size=n, max_size=n), st.just([0])
        )
        return st.fixed_dictionaries(
            {"distance": same, "status": status.map(lambda v: array.array("B", v))}
        )

    return st.tuples(
        length.flatmap(axes),
        length.flatmap(distance),
        COUNTS,
        COUNTS,
        PERIODS,
        st.integers(0, 2**31),
    )


CALIBRATIONS = st.fixed_dictionaries(
    {},
    optional={
        "numerator": doubles(8),
        "denominator": doubles(8),
        "covariance": doubles(60),
        **dict.fromkeys(("delay", "static_gain", "sample_period", "valid_up_to"), NUMBERS),
        **dict.fromkeys(("settings", "certificate", "id"), TEXTS),
    },
)
FUZZ = {"database": None, "suppress_health_check": list(HealthCheck), "derandomize": True}


@pytest.mark.parametrize("count", [10, *soaked(20_000)])
def test_messages(cell, true_calibration, small_scan_blocks, count):
    path = cell.folder / "cal.json"
    save_calibration(path, true_calibration)
    cell.processes.start("corrector", calibration=str(path))
    cell.processes.start("calibrator", output=str(cell.folder / "kept.json"))
    latched = cell.operator.create_publisher(Calibration, "/omsm/calibration", LATCHED_QOS)
    axes = cell.publisher("axes", AxisBlock, 2)
    distance = cell.publisher("confocal", DistanceBlock, 2)
    messages = message_mapping.ros_messages()

    @settings(max_examples=count, **FUZZ)
    @given(blocks(), CALIBRATIONS)
    def attack(block, calibration):
        x, d, first, other, period, second = block
        header = message_mapping.header(messages, second * 10**9 // 7, "f")
        axes.publish(AxisBlock(header=header, first_sample=first, sample_period=period, **x))
        distance.publish(
            DistanceBlock(header=header, first_sample=other, sample_period=period, **d)
        )
        message = message_mapping.calibration_message(messages, true_calibration, 0)
        for name, value in calibration.items():
            setattr(message, name, value)
        latched.publish(message)

    attack()
    for node in ("corrector", "calibrator"):
        cell.settle(node, "blocks_refused")
    before = cell.settle("corrector", "axes_received")
    for pair in small_scan_blocks[:20]:
        axes.publish(message_mapping.block_message(messages, pair[0]))
        distance.publish(message_mapping.block_message(messages, pair[1]))
    sent = sum(len(pair[0]) for pair in small_scan_blocks[:20])
    cell.wait(
        "the good blocks",
        lambda: cell.operator.value("corrector", "axes_received") >= before + sent,
    )
    assert cell.operator.text("corrector", "calibration") == true_calibration.id
    for node in ("corrector", "calibrator"):
        assert cell.operator.value(node, "defects") == 0, cell.operator.text(node, "message")
    cell.processes.check()


REQUESTS = st.one_of(
    st.tuples(
        st.just((LoadCalibration, "corrector/load_calibration")),
        st.fixed_dictionaries({"path": PATHS}),
    ),
    st.tuples(
        st.just((PredictError, "corrector/predict_error")),
        st.fixed_dictionaries(
            {}, optional={"bag": PATHS, "z": doubles(300), "sample_period": NUMBERS}
        ),
    ),
    st.tuples(
        st.just((Identify, "calibrator/identify")),
        st.fixed_dictionaries(
            {},
            optional={
                "bag": PATHS,
                "duration": NUMBERS,
                "input": TEXTS,
                "order": st.integers(0, 2**32 - 1),
            },
        ),
    ),
)


@pytest.mark.parametrize("count", [8, *soaked(1_000)])
def test_requests(cell, true_calibration, count):
    path = cell.folder / "cal.json"
    save_calibration(path, true_calibration)
    cell.processes.start("corrector", calibration=str(path))
    cell.processes.start("calibrator", output=str(cell.folder / "kept.json"))
    clients, answers = {}, []

    @settings(max_examples=count, **FUZZ)
    @given(REQUESTS)
    def attack(request):
        (kind, name), given = request
        if name not in clients:
            clients[name] = cell.operator.create_client(kind, f"/omsm/{name}")
            assert clients[name].wait_for_service(20.0)
            cell.settle("corrector", "clouds_published")
        future = clients[name].call_async(kind.Request(**given))
        cell.wait(f"an answer to {name} {given!r}", future.done)
        answers.append(future.result())

    attack()
    assert all(answer.message for answer in answers)
    assert not any("root:" in answer.message for answer in answers)
    cell.settle("corrector", "clouds_published")
    assert cell.operator.text("corrector", "calibration") == true_calibration.id
    for node in ("corrector", "calibrator"):
        assert cell.operator.value(node, "defects") == 0, cell.operator.text(node, "message")
