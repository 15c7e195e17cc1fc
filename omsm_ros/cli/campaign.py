"""The command batch: correct a folder of recordings."""

import argparse
import hashlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from urllib.parse import quote, urlsplit

from omsm_ros import __version__
from omsm_ros.cli.arguments import ADDRESS, Arguments
from omsm_ros.cli.command import CliCommand, Facts, Rows, say, written
from omsm_ros.errors import ConfigurationError, FileError
from omsm_ros.io.calibration_file import load_calibration
from omsm_ros.io.files import (
    REPORT,
    SUMMARY,
    exception_text,
    explained_errors,
    load_object,
    locked_folder,
    make_folder,
    save_json,
    save_text,
)
from omsm_ros.io.json_and_yaml import TEXT, group, or_none, ranged
from omsm_ros.io.results import read_summary
from omsm_ros.pipelines.history import recorded_ns_of
from omsm_ros.pipelines.progress import Progress, state_progress
from omsm_ros.quantities import PROCESSES, STAMP, shown

DONE, REFUSED, CRASHED = "done", "refused", "crashed"
STATE = "campaign.json"

_SCHEMA = "omsm-campaign/1"
_MAX_STATE_BYTES = 50_000_000
# A process that the system killed for lack of memory may succeed once others have ended.
_ATTEMPTS = 2
# A scheduler answers within this time [s].
_ANSWER_S = 10.0
_LOCAL_HOSTS = ("127.0.0.1", "::1", "localhost")

_ENTRY = group(
    {
        **dict.fromkeys(("bag", "folder", "fingerprint", "said"), TEXT),
        "state": {"enum": [DONE, REFUSED, CRASHED]},
    },
    recorded_ns=or_none(ranged(STAMP)),
)
_ENTRIES = {"type": "array", "maxItems": 1_000_000, "items": _ENTRY}
_STATE_FORM = group({"schema": {"const": _SCHEMA}, "entries": _ENTRIES})


@dataclass(frozen=True, slots=True)
class Entry:
    """State of one bag of a campaign.

    bag: path below the campaign's folder;  folder: of its result, below that of the results
    fingerprint: hash of bag, calibration and options
    state: "done", "refused" (said: why) or "crashed" (said: by which signal)
    recorded_ns: when the recording began [ns, ROS time], None if unknown
    """

    bag: str
    folder: str
    fingerprint: str
    state: str
    said: str
    recorded_ns: int | None = None


def run_campaign(
    folder: Path, calibration: Path, out: Path, options: Sequence[str] = (), *, jobs: int = 0,
    scheduler: str = "", progress: Progress = state_progress,
) -> list[Entry]:  # fmt: skip
    """Correct every bag below ``folder`` into ``out``; return the state of each, by name.

    options: of ``omsm correct``, for every bag;  jobs: parallel processes, 0 = one per core
    scheduler: address of a Dask scheduler whose workers share these folders, empty = this host

    A bag that has a result of the same bag, calibration and options is skipped. Raises FileError
    if there is no bag, or another campaign writes into ``out``.
    """
    found = bags_below(folder, out)
    if not found:
        raise FileError(
            f"no bag below {str(folder)!r}; give a folder of .mcap files or rosbag2 bags; "
            "convert other recordings with 'omsm import'"
        )
    sign = [load_calibration(calibration).id, *options, __version__]
    with _locked(out):
        earlier = {entry.bag: entry for entry in load_campaign(out)}
        tasks = [_task(bag, folder, calibration, out, options, sign) for bag in found]
        entries = {e.bag: earlier[e.bag] for e, _ in tasks if _is_done(earlier.get(e.bag), e, out)}
        waiting = [task for task in tasks if task[0].bag not in entries]
        progress(len(entries), len(tasks))
        with _executor(jobs or os.cpu_count() or 1, scheduler) as executor:
            asked = {executor.submit(correct_one, *task): task[0] for task in waiting}
            for future in as_completed(asked):
                entry = asked[future]
                entries[entry.bag] = _result(future, entry)
                _save(out, entries)
                progress(len(entries), len(tasks))
        _save(out, entries)
    return [entries[entry.bag] for entry, _ in tasks]


def bags_below(folder: Path, out: Path) -> list[Path]:
    """Return the bags below ``folder``, by name: folders of rosbag2 and bare .mcap files."""
    if not folder.is_dir():
        raise FileError(f"no folder {str(folder)!r}; give one that holds bags")
    found = []
    for place, folders, files in os.walk(folder):
        here = Path(place)
        folders[:] = sorted(f for f in folders if (here / f).resolve() != out.resolve())
        if "metadata.yaml" in files:
            found.append(here)
            folders.clear()
        else:
            found += [here / name for name in files if name.endswith(".mcap")]
    return sorted(found)


def load_campaign(out: Path) -> list[Entry]:
    """Return the states that an earlier run saved in ``out``; none without one."""
    path = out / STATE
    if not path.exists():
        return []
    content = load_object(path, "campaign", _MAX_STATE_BYTES, _STATE_FORM)
    known = Entry.__dataclass_fields__
    return [Entry(**{k: v for k, v in e.items() if k in known}) for e in content["entries"]]


def correct_one(entry: Entry, command: Sequence[str]) -> Entry:
    """Correct one bag in a process of its own; return its entry with what became of it."""
    found = replace(entry, state=REFUSED, said="not started")
    for _ in range(_ATTEMPTS):
        try:
            done = subprocess.run(
                [sys.executable, "-m", "omsm_ros.cli", *command],
                stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
            )  # fmt: skip
        except OSError as err:
            found = replace(entry, state=CRASHED, said=exception_text(err))
            continue
        if done.returncode == 0:
            return replace(entry, state=DONE, recorded_ns=recorded_ns_of(Path(command[1])))
        last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
        if done.returncode > 0:
            return replace(entry, state=REFUSED, said=last.removeprefix("omsm: "))
        said = f"ended by {signal.Signals(-done.returncode).name}"
        found = replace(entry, state=CRASHED, said=said)
    return found


def _result(future: Future[Entry], entry: Entry) -> Entry:
    """Return the result of :func:`correct_one`, also if every worker died that tried it."""
    try:
        return future.result()
    except Exception as err:  # a scheduler raises errors of many kinds for lost workers
        return replace(entry, state=CRASHED, said=f"no worker finished it ({type(err).__name__})")


def _state(file: Path) -> tuple[str, int, int]:
    """Return name, size and time of a file; zeros for a dangling link.

    The correction of the bag then reports the error of that bag.
    """
    try:
        found = file.stat()
    except OSError:
        return file.name, 0, 0
    return file.name, found.st_size, found.st_mtime_ns


def _task(
    bag: Path, folder: Path, calibration: Path, out: Path, options: Sequence[str], sign: list[str]
) -> tuple[Entry, list[str]]:
    """Return the entry of a bag that waits, and its command, which can be sent to another host."""
    name = bag.relative_to(folder)
    # A folder bag of the same stem has a result of that name.
    taken = (bag.with_suffix("") / "metadata.yaml").is_file()
    result = name.with_suffix("") if bag.is_file() and not taken else name
    files = sorted(bag.rglob("*")) if bag.is_dir() else [bag]
    states = [_state(file) for file in files]
    fingerprint = hashlib.sha256(repr((states, sign)).encode()).hexdigest()
    command = ["correct", str(bag.absolute()), "--calibration", str(calibration.absolute())]
    command += ["--out", str((out / result).absolute()), "--json", *options]
    return Entry(str(name), str(result), fingerprint, "", ""), command


def _is_done(known: Entry | None, entry: Entry, out: Path) -> bool:
    """Return True if the result of this bag exists; failed ones are tried again."""
    return (
        known is not None
        and known.state == DONE
        and known.fingerprint == entry.fingerprint
        and (out / entry.folder / SUMMARY).is_file()
    )


def _save(out: Path, entries: dict[str, Entry]) -> None:
    content = [asdict(entries[name]) for name in sorted(entries)]
    save_json(out / STATE, {"schema": _SCHEMA, "entries": content})


@contextmanager
def _locked(out: Path) -> Iterator[None]:
    """Lock the folder, so that two campaigns never write into it."""
    with ExitStack() as locked:
        said, remedy = f"cannot write into {str(out)!r}", "give another folder"
        with explained_errors(said, remedy, caught=OSError):
            make_folder(out)
            try:
                locked.enter_context(locked_folder(out, wait=False))
            except BlockingIOError as err:
                raise FileError(
                    f"another campaign writes into {str(out)!r}; wait until it has ended"
                ) from err
        yield


@contextmanager
def _executor(jobs: int, scheduler: str) -> Iterator[Executor]:
    if not scheduler:
        # Threads that wait for processes: a killed process would break a process pool.
        executor = ThreadPoolExecutor(jobs)
        try:
            yield executor
        finally:
            executor.shutdown(cancel_futures=True)
        return
    said, remedy = f"scheduler {scheduler!r} is no address", "write tcp://host:port"
    with explained_errors(said, remedy, ConfigurationError):
        address = urlsplit(scheduler)
    local = address.scheme == "tcp" and address.hostname in _LOCAL_HOSTS
    if not (local or address.scheme == "tls"):
        raise ConfigurationError(
            f"scheduler {scheduler!r}: Dask runs any code it is sent, so on another host it must "
            "be tls://host:port, with the certificates in Dask's own configuration"
        )
    said, remedy = f"no scheduler answers at {scheduler!r}", "start one there with 'dask scheduler'"
    with explained_errors(said, remedy, ConfigurationError, (OSError, ValueError, TypeError)):
        if local:
            # Dask itself waits without end for the greeting of a scheduler.
            with socket.create_connection((address.hostname, address.port), _ANSWER_S) as link:
                link.recv(1)
        try:
            from distributed import Client
        except ImportError as err:
            raise ConfigurationError("--scheduler needs Dask: pip install distributed") from err
        client = Client(scheduler, timeout=_ANSWER_S)
    with client:
        # If a worker dies, another one takes over its bag.
        yield client.get_executor(pure=False, retries=3)


_INDEX = "index.html"

# Options that the campaign sets for each bag, and the length of "--" with one letter, the shortest
# abbreviation that argparse accepts.
_DECIDED, _SHORTEST = ("--out", "--calibration"), 3


def _declare_batch(add: Arguments) -> None:
    add("folder", "FOLDER", "folder of bags, at any depth")
    add("--calibration", "CAL.json", required=True)
    add("--out", "DIR", required=True)
    add("--jobs", PROCESSES, "number of parallel processes; default: one per core", default=0)
    add("--scheduler", str, default="", metavar="URL")
    add.catalogue()
    add.epilog("Options of 'omsm correct' for every bag follow after '--'.")


def _batch(args: argparse.Namespace) -> Facts:
    entries = run_campaign(
        args.folder, args.calibration, args.out, _options(args),
        jobs=args.jobs, scheduler=args.scheduler,
    )  # fmt: skip
    _write_index(args.out, args.folder.name, entries, args.calibration)
    return {"out": str(args.out), "entries": [asdict(entry) for entry in entries]}


def _options(args: argparse.Namespace) -> list[str]:
    """Return the options of every correction, with the catalogue unless the environment names it.

    Raises ConfigurationError for options that the campaign sets for each bag.
    """
    for word in args.passed_on:
        name = word.partition("=")[0]
        if len(name) > _SHORTEST and (own := [o for o in _DECIDED if o.startswith(name)]):
            raise ConfigurationError(
                f"{own[0]} is given after '--' as {shown(word)}; give it before, once for all bags"
            )
    if args.catalogue == os.environ.get(ADDRESS, ""):
        return list(args.passed_on)
    return [*args.passed_on, "--catalogue", args.catalogue]


def _write_index(out: Path, title: str, entries: list[Entry], calibration: Path) -> None:
    # Imported on demand, because loading the figures takes a second.
    from omsm_ros.report.campaign import CampaignEntry, render

    measurements = [
        CampaignEntry(
            e.bag, e.state, e.said, e.recorded_ns,
            _link(out, e), read_summary(out / e.folder / SUMMARY) if e.state == DONE else {},
        )
        for e in entries
    ]  # fmt: skip
    save_text(
        out / _INDEX, render(f"Campaign {title}", measurements, load_calibration(calibration))
    )


def _link(out: Path, entry: Entry) -> str:
    """Return the link from the index to a bag's report; empty if it has none."""
    page = os.path.join(entry.folder, REPORT)
    return quote(page) if (out / page).exists() else ""


def _show_batch(facts: Facts) -> Rows:
    for entry in facts["entries"]:
        if entry["state"] != DONE:
            say(f"{entry['bag']}: {entry['state']}, {entry['said']}")
    done = sum(entry["state"] == DONE for entry in facts["entries"])
    say(f"{done} of {len(facts['entries'])} bags are done")
    return [written([_INDEX], facts["out"])]


def _undone(facts: Facts) -> str:
    others = [entry for entry in facts["entries"] if entry["state"] != DONE]
    if not others:
        return ""
    return (
        f"{len(others)} bags gave no result, first {others[0]['bag']!r}: {others[0]['said']}; "
        "the same command retries them"
    )


COMMANDS = (CliCommand("batch", _declare_batch, _batch, _show_batch, _undone),)
