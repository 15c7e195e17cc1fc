"""A measurement for people: figures and one self-contained HTML page."""

import logging
import os

# Here before matplotlib loads: it says on stderr that there is no home to keep its list of fonts
# in, and ends on a backend that it does not know, though figures are drawn without any.
logging.getLogger("matplotlib").setLevel(logging.ERROR)
os.environ["MPLBACKEND"] = "agg"
