"""Every error that a user may meet says what to do, also those that no case has raised yet."""

import ast
import re
from functools import cache
from pathlib import Path

import omsm_ros
from omsm_ros.messages import templates

from .judge import REMEDIES

HOME = Path(omsm_ros.__file__).parent
# Those of devices and wires are retried and counted; a twin's are for who writes one.
ROOMS = ("cli", "core", "pipelines", "nodes", "report", "io", "live_page")
# Of Python, or meant for a caller and worded where they are caught.
OTHERS = {
    "ArgumentTypeError", "AttributeError", "BlockingIOError", "FileExistsError", "KeyError",
    "LookupError", "NotADirectoryError", "OSError", "OverflowError", "ReaderError",
    "RuntimeError", "TypeError", "ValueError",
}  # fmt: skip
HOLE = "{}"


def wording(node):
    """The text of a message; what is put in when it is raised is a hole."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(wording(part) for part in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return wording(node.left) + wording(node.right)
    if isinstance(node, ast.Call) and node.args and "shortened" in ast.unparse(node.func):
        return wording(node.args[0])
    return HOLE


@cache
def messages():
    return list(_messages())


def _messages():
    for path in sorted(path for room in ROOMS for path in (HOME / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)):
                continue
            name = ast.unparse(node.exc.func).rsplit(".", 1)[-1]
            if name.endswith("Error") and name not in OTHERS and node.exc.args:
                place = f"{path.relative_to(HOME)}:{node.lineno}"
                message = wording(node.exc.args[0])
                # A code stands for its sentence, in which values are holes.
                sentence = templates().get(message, message)
                yield place, re.sub(r"\{[^{}]*\}", HOLE, sentence)


def test_every_message_says_what_to_do():
    silent = [
        (place, message)
        for place, message in messages()
        # One that ends in a hole ends in what another says: an error's text, a remedy by its name.
        if not re.search(r"\{\}['\"]?$", message)
        and not any(word in message.lower() for word in REMEDIES)
    ]
    assert silent == []


def test_messages_are_found():
    found = [message for _, message in messages()]
    assert len(found) > 400
    assert sum(message == HOLE for message in found) < len(found) / 10
