"""Reports: figures and self-contained HTML pages of calibrations, measurements and studies."""

import logging
import os

# Set before matplotlib loads: otherwise it warns on stderr about a missing home folder, and fails
# on an unknown backend although figures are drawn without one.
logging.getLogger("matplotlib").setLevel(logging.ERROR)
os.environ["MPLBACKEND"] = "agg"
