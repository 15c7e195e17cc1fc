"""The importer of the files of a folder."""

import pytest

from omsm_ros.io import bags
from omsm_ros.io.tables.table import load_column_map
from omsm_ros.pipelines.importing import import_recording
from omsm_ros.pipelines.recording import Recording


class Importer:
    """Imports files of a folder by a map, and reads the bag made of them."""

    def __init__(self, folder):
        self.folder = folder
        self.out = folder / "out.mcap"

    def __call__(self, mapping, *files):
        """Import the named files; return the report of each."""
        (self.folder / "map.yaml").write_text(mapping, encoding="utf-8")
        mapped, form = load_column_map(self.folder / "map.yaml")
        return import_recording([self.folder / f for f in files], mapped, form, self.out)

    def blocks(self, topic=bags.DISTANCE_TOPIC):
        with Recording(self.out) as recording:
            return recording.recorded(topic)[topic]


@pytest.fixture
def importer(tmp_path):
    return Importer(tmp_path)
