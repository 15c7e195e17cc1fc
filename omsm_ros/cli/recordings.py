"""Commands for recordings: record a device; inspect or repair a bag; import other recordings."""

import argparse
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from omsm_ros.cli.arguments import Arguments, cell_of
from omsm_ros.cli.command import CliCommand, Facts, Rows, say, warn, written
from omsm_ros.core.streams.stream_faults import StreamWatch, counter_skew, skew_fault
from omsm_ros.errors import ConfigurationError
from omsm_ros.io import bags
from omsm_ros.io.json_and_yaml import mapping_of
from omsm_ros.io.tables.table import load_column_map
from omsm_ros.io.topics import AnyBag, relative
from omsm_ros.pipelines.importing import import_recording
from omsm_ros.pipelines.recording import Recording
from omsm_ros.quantities import DURATION, SILENCE
from omsm_ros.readable import quantity

_NO_INDEX = (
    "the file has no index: its recording was interrupted or the disk was full, so its end may be "
    "missing; 'omsm inspect --repair' makes a copy with an index"
)


def inspect_bag(path: AnyBag) -> Facts:
    """Return the topics of a bag, its faults as text, and its vibration levels.

    topics: messages and samples of each; ``gaps`` of the trigger counter with the ``missing``
    samples; ``restarts`` of the counter; ``invalid`` readings of the probe or axes
    """
    with Recording(path) as bag:
        topics = bag.topics()
        present = [t.role for t in topics if t.role in bags.BLOCK_TOPICS and t.messages]
        watches = {topic: StreamWatch() for topic in present}
        for topic, block in bag.stream(*present):
            watches[topic].add(block)
        if bag.holds(bags.ACCELERATION_TOPIC):
            watches[bags.ACCELERATION_TOPIC] = StreamWatch()
            for topic, block in bag.records(bags.ACCELERATION_TOPIC):
                watches[topic].add(block)
        faults = [] if bag.indexed else [_NO_INDEX]
        faults += [
            f"no {what}: nothing on {bag.name_of(topic)!r}, which identify and correct need"
            for topic, what in ((bags.AXES_TOPIC, "axes"), (bags.DISTANCE_TOPIC, "distance"))
            if topic not in watches
        ]
        vibration = _vibration(bag.vibration())
    for topic, watch in watches.items():
        faults += map(str, watch.faults(relative(topic)))
    axes, distance = watches.get(bags.AXES_TOPIC), watches.get(bags.DISTANCE_TOPIC)
    if axes and distance and axes.samples and distance.samples:
        period = min(axes.periods)
        if period == min(distance.periods):
            faults += map(str, skew_fault(counter_skew(axes, distance), period))
    rows = [_topic_facts(t, watches.get(t.role)) for t in topics]
    return {"topics": rows, "faults": faults, "vibration": vibration}


def _vibration(levels: Sequence[Mapping[str, Any]]) -> Facts | None:
    """Return the largest levels of all spectra that the monitor reported; None without any.

    rms: of each axis by band [m/s²];  height, height_total: effect on a height, rms [m], None
    without a calibration;  alarms: number of spectra during which the alarm was raised
    """
    # The bands depend on the sampling rate; only spectra with those of the last one compare.
    alike = [one for one in levels if one["bands"] == levels[-1]["bands"]]
    if not alike:
        return None
    heights = [one for one in alike if one["height"] is not None]

    def largest(bands: Iterable[Sequence[float]]) -> list[float]:
        return [float(max(band)) for band in zip(*bands, strict=True)]

    return {
        "spectra": len(levels),
        "alarms": sum(one["alarm"] for one in levels),
        "bands": alike[-1]["bands"],
        "rms": {axis: largest(one["rms"][axis] for one in alike) for axis in alike[-1]["rms"]},
        "height": largest(one["height"] for one in heights) if heights else None,
        "height_total": max((one["height_total"] for one in heights), default=None),
    }


def _topic_facts(topic: bags.TopicSummary, watch: StreamWatch | None) -> Facts:
    found: Facts = {"topic": topic.topic, "type": topic.type, "messages": topic.messages}
    names = ("samples", "sample_period", "duration", "gaps", "missing", "restarts", "invalid")
    if watch is None or not watch.samples:
        return found | dict.fromkeys(names, 0)
    period = min(watch.periods)
    values = (watch.samples, period, float(watch.samples * period), watch.places, watch.missing)
    return found | dict(zip(names, (*values, watch.restarts, watch.invalid), strict=True))


def _declare_inspect(add: Arguments) -> None:
    add.bags("bag")
    add("--repair", None)


def _inspect(args: argparse.Namespace) -> Facts:
    if not args.repair:
        return {"bag": str(args.bag), **inspect_bag(cell_of(args.bag, args))}
    from omsm_ros.io.bag_repair import repair  # rarely used and slow to load

    made = repair(args.bag)
    return {
        "bag": str(args.bag),
        "repaired": str(made.path),
        "messages": dict(made.messages),
        "lost": made.lost,
        "lost_unnamed": made.unnamed,
    }


def _show_inspect(facts: Facts) -> Rows:
    if "repaired" in facts:
        saved = [(topic, f"{count} messages saved") for topic, count in facts["messages"].items()]
        lost = [("lost", text) for text in facts["lost"]] or [("lost", "nothing")]
        if more := facts["lost_unnamed"]:
            lost.append(("lost", f"and {more} more places"))
        return [written([facts["repaired"]]), *saved, *lost]
    row = "{topic:<22} {messages:>9} {samples:>11} {rate:>9} {gaps:>6} {restarts:>8} {invalid:>8}"
    names = ("topic", "messages", "samples", "gaps", "restarts", "invalid")
    say(row.format(rate="rate Hz", **{name: name for name in names}))
    for topic in facts["topics"]:
        period = topic["sample_period"]
        say(row.format(rate=f"{1 / period:g}" if period else "-", **topic))
    faults = [("fault", text) for text in facts["faults"]] or [("faults", "none found")]
    return [*_vibration_rows(facts["vibration"]), *faults]


def _vibration_rows(found: Facts | None) -> Rows:
    if found is None:
        return []
    rows = []
    for place, (low, high) in enumerate(found["bands"]):
        levels = ", ".join(f"{a} {quantity(v[place], 'm/s²')}" for a, v in found["rms"].items())
        effect = quantity(found["height"][place], "m") if found["height"] else "not evaluated"
        rows.append((f"{low:g} to {high:g} Hz", f"at most {levels}; on a height {effect} rms"))
    total = found["height_total"]
    said = "not evaluated: no calibration" if total is None else f"{quantity(total, 'm')} rms"
    raised = f"alarm in {found['alarms']} of {found['spectra']} spectra"
    return [("vibration", f"on a height at most {said}; {raised}"), *rows]


def _declare_record(add: Arguments) -> None:
    add("--device", str, "model, as of the node confocal_driver", default="linuxcnc")
    add("--port", str, "its address, such as tcp://127.0.0.1:7010", required=True)
    add("--out", "BAG.mcap", required=True)
    add("--seconds", DURATION, "duration in samples [s]; 0: until Ctrl+C", default=0.0)
    add("--silence", SILENCE, "end this long after the last sample [s]; 0: never", default=0.0)
    add("--set", str, nargs="+", default=[], metavar="NAME=VALUE")


def _record(args: argparse.Namespace) -> Facts:
    # Imported on demand, because 'inspect' needs no devices.
    from omsm_ros.pipelines.record_bags import record_device

    given: Facts = {"device": args.device, "port": args.port}
    for text in args.set:
        given |= mapping_of(text.replace("=", ": ", 1), ConfigurationError, f"--set {text}")
    period = given.get("sample_period", 1e-3)

    def ended(samples: int, silent: float) -> bool:
        if samples and 0 < args.silence < silent:
            return True
        return bool(args.seconds and samples * period >= args.seconds)

    def waits(reason: str) -> None:
        warn(f"{reason}; waiting for the first, Ctrl+C ends it")

    return record_device(given, args.out, ended, waits)


def _show_record(facts: Facts) -> Rows:
    counted = [(name.replace("_", " "), str(n)) for name, n in facts.items() if name != "bag"]
    return [*counted, written([facts["bag"]])]


def _declare_import(add: Arguments) -> None:
    add("files", "FILE", nargs="+")
    add("--map", "MAP.yaml", "columns, units, signs, period", required=True)
    add("--out", "BAG.mcap", required=True)


def _import(args: argparse.Namespace) -> Facts:
    mapped, form = load_column_map(args.map)
    found = import_recording(args.files, mapped, form, args.out)
    return {"bag": str(args.out), "files": [asdict(file) for file in found]}


def _show_import(facts: Facts) -> Rows:
    for file in facts["files"]:
        kinds = " and ".join(kind for kind in ("axes", "distance") if file[kind])
        say(f"{file['file']}: {file['rows']} rows of {kinds} at {1 / file['sample_period']:g} Hz")
        for count, meaning in (
            ("missing", "missing trigger numbers"),
            ("invalid", "invalid probe readings"),
            ("lost", "rows with an axis that is not a number"),
            ("repeated_names", "repeated header lines"),
            ("passed_over", "messages without any of the columns"),
        ):
            if file[count]:
                say(f"    {meaning}: {file[count]}")
    if any(file["own_clock"] for file in facts["files"]):
        say("probe and axes have separate clocks: identify and correct with --by-stamps")
    return [written([facts["bag"]]), ("next", "check the bag with 'omsm inspect'")]


COMMANDS = (
    CliCommand("import", _declare_import, _import, _show_import),
    CliCommand("record", _declare_record, _record, _show_record),
    CliCommand("inspect", _declare_inspect, _inspect, _show_inspect),
)
