"""``MODEL.json``: a model between any two sampled quantities."""

from __future__ import annotations

from pathlib import Path

from omsm_ros.core.sampled.model import SampledModel
from omsm_ros.storage.files import save_json


def save_model(path: Path | str, model: SampledModel) -> None:
    """Write ``MODEL.json`` (schema "omsm-model/1")."""
    save_json(path, model.content())
