"""On-machine surface measurement with the dynamic error of the loop corrected."""

from collections.abc import Mapping
from typing import Any

from omsm_ros import errors

__version__ = "0.1.0"


def _sentence(code: str, values: Mapping[str, Any]) -> str:
    """Return the text of an error; the templates are loaded when the first one is written."""
    from omsm_ros import messages

    return messages.sentence(code, values)


errors.write_texts_with(_sentence)
