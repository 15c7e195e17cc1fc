"""Substitute for `ros2` where only the wheels of ROS are installed.

It is called as `python ros2.py run omsm_ros NODE …`.

`run` and `launch` return when their nodes are active, and leave them running. Each node is a line
in the file that the variable PAGE_NODES names, so that the test can stop all of them. A further
`launch` stops the nodes of the one before, as a reader would by Ctrl-C. If the variable REAL_ROS2
names a real `ros2`, that is used for everything it can do.
"""

import importlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import yaml

NODES = Path(os.environ["PAGE_NODES"])
REAL = os.environ.get("REAL_ROS2", "")
DEADLINE_S = 60.0
KEPT = "cell_emulator"


def background(name, command, env=None):
    log = NODES.with_suffix(f".{name}.log").open("ab")
    started = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
        env={**os.environ, **(env or {})},
    )  # fmt: skip
    with NODES.open("a") as nodes:
        nodes.write(f"{started.pid} {name}\n")
    return started


def run(package, executable, *arguments):
    name = {"replay": "player"}.get(executable, executable)
    (namespace,) = [a[6:] for a in arguments if a.startswith("__ns:=")] or ["/omsm"]
    own = [REAL, "run", package] if REAL else []
    nodes = [name]
    if executable == "cell":  # it has nodes of the same names, with the same files
        end_all_but(KEPT)
        nodes = arguments[arguments.index("--nodes") + 1].split()
    started = background(name, [*own, executable, *arguments])
    wait_for(namespace, nodes, started)


def launch(package, file, *arguments):
    given = dict(a.split(":=", 1) for a in arguments)
    end_all_but(KEPT)
    namespace = given.get("namespace", "omsm")
    if REAL:
        started = background("launch", [REAL, "launch", package, file, *arguments])
        names = {"replay.launch.py": []}.get(file, ["confocal_driver", "calibrator", "corrector"])
        if not names:
            sys.exit(started.wait(DEADLINE_S))  # it ends with its bag
        wait_for(namespace, names, started)
        return
    from launch_stand_in import modules, nodes_of

    sys.modules.update(modules())
    for node in nodes_of(file, **given):
        words = []
        for parameters in node.parameters:
            if isinstance(parameters, str):
                words += ["--params-file", parameters]
            else:
                for key, value in parameters.items():
                    words += ["-p", f"{key}:={yaml.safe_dump(value).split(chr(10))[0]}"]
        words = ["-r", f"__ns:=/{namespace.strip('/')}", *words]
        command = [node.executable, *node.arguments, *words]
        started = background(node.executable, command)
        wait_for(namespace, [node.executable], started)


def end_all_but(kept):
    """Stop earlier nodes as Ctrl-C does; the file keeps those that go on."""
    lines = NODES.read_text().splitlines() if NODES.exists() else []
    ended = [line for line in lines if line.split()[1] != kept]
    for line in ended:
        os.killpg(int(line.split()[0]), signal.SIGINT)
    for line in ended:
        until = time.monotonic() + DEADLINE_S
        while Path(f"/proc/{line.split()[0]}/cmdline").exists() and alive(line.split()[0]):
            assert time.monotonic() < until, line
            time.sleep(0.05)
    NODES.write_text("".join(f"{line}\n" for line in lines if line not in ended))


def alive(pid):
    return Path(f"/proc/{pid}/stat").read_text().rsplit(") ", 1)[1][0] != "Z"


def wait_for(namespace, names, started):
    """Wait until nodes are active, or until the process has ended without error."""
    from lifecycle_msgs.srv import GetState

    for name in names:
        client = NODE.create_client(GetState, f"/{namespace.strip('/')}/{name}/get_state")
        until = time.monotonic() + DEADLINE_S
        while True:
            if started.poll() is not None:
                sys.exit(started.returncode)
            assert time.monotonic() < until, f"{name} is not active"
            if client.service_is_ready():
                reply = asked(client, GetState.Request())
                if reply is not None and reply.current_state.label == "active":
                    break
            time.sleep(0.2)


def asked(client, request, seconds=5.0):
    waiting = client.call_async(request)
    rclpy.spin_until_future_complete(NODE, waiting, timeout_sec=seconds)
    return waiting.result()


def service(verb, name, kind, content="{}"):
    assert verb == "call"
    found = interface(kind)
    client = NODE.create_client(found, name)
    assert client.wait_for_service(DEADLINE_S), f"no service {name}"
    time.sleep(0.5)  # a server that has not seen us yet drops its answer
    reply = asked(client, found.Request(**yaml.safe_load(content)), DEADLINE_S)
    print(f"response:\n{reply}")
    if not getattr(reply, "success", True):
        sys.exit(1)


def interface(kind):
    package, folder, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.{folder}"), name)


def topic(verb, name):
    assert verb == "echo"
    until, found = time.monotonic() + DEADLINE_S, None
    while found is None:
        assert time.monotonic() < until, f"nobody publishes {name}"
        rclpy.spin_once(NODE, timeout_sec=0.1)
        found = dict(NODE.get_topic_names_and_types()).get(name)
    heard = []
    NODE.create_subscription(interface(found[0]), name, heard.append, 10)
    while not heard:
        assert time.monotonic() < until, f"nothing comes on {name}"
        rclpy.spin_once(NODE, timeout_sec=0.1)
    print(heard[0])


def lifecycle(verb, node="", transition=""):
    from lifecycle_msgs.msg import Transition
    from lifecycle_msgs.srv import ChangeState

    if verb == "nodes":
        time.sleep(1.0)
        found = [name for name, _ in NODE.get_service_names_and_types()]
        print("\n".join(name.removesuffix("/get_state") for name in found if "/get_state" in name))
        return
    assert verb == "set"
    client = NODE.create_client(ChangeState, f"{node}/change_state")
    assert client.wait_for_service(DEADLINE_S), f"no node {node}"
    number = getattr(Transition, f"TRANSITION_{transition.upper()}")
    reply = asked(client, ChangeState.Request(transition=Transition(id=number)), DEADLINE_S)
    print("Transitioning successful" if reply.success else "Transitioning failed")
    sys.exit(not reply.success)


def play(motion):
    """Let the emulated machine make a motion, and wait for its end."""
    from diagnostic_msgs.msg import DiagnosticArray

    said = []
    NODE.create_subscription(
        DiagnosticArray, "/diagnostics",
        lambda message: said.extend(s.message for s in message.status if KEPT in s.name), 10,
    )  # fmt: skip
    service("call", f"/omsm/{KEPT}/{motion}", "std_srvs/srv/Trigger")
    until = time.monotonic() + DEADLINE_S
    while not (any("playing" in one for one in said) and said[-1] == "waiting"):
        assert time.monotonic() < until, said[-3:]
        rclpy.spin_once(NODE, timeout_sec=0.1)


VERBS = {f.__name__: f for f in (run, launch, service, topic, lifecycle, play)}

if __name__ == "__main__":
    verb, *words = sys.argv[1:]
    if REAL and verb not in ("run", "launch", "play"):
        once = ["--once"] if words[:1] == ["echo"] else []
        os.execv(REAL, [REAL, verb, *words, *once])
    import rclpy

    rclpy.init(args=[])
    NODE = rclpy.create_node("follows_the_page")
    VERBS[verb](*words)
