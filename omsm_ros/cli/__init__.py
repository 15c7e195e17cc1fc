"""``omsm``: the offline commands.

Exit status 0: done; 2: bad input, with one line on stderr that says what to do; 70: a defect
of ours, with one line on stderr that says what to report. With ``--json`` standard output holds
one JSON object and nothing else.
"""

from omsm_ros.cli.main import main

__all__ = ["main"]
