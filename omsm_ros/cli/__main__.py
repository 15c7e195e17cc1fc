"""``python -m omsm_ros.cli``."""

import sys

from omsm_ros.cli import main

sys.exit(main())
