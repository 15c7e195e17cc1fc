"""Make the ROS wheels' CMake exports fit this machine; run by the venv's Python.

The wheels were exported with the include folders of the machine that built
them, and CMake refuses a target whose include folder does not exist.

Their generators of C++ messages are left out: no wheel has rclcpp, which would
use them, and they take half of the time that building our messages takes.
"""

import re
import sys
import sysconfig
from pathlib import Path

import numpy

HERE = {
    r"/opt/python/[^/;\"]+/include/python3\.\d+": sysconfig.get_path("include"),
    r"/opt/python/[^/;\"]+/lib/python3\.\d+/site-packages/numpy/_core/include": numpy.get_include(),
}

for export in Path(sys.prefix, "share").glob("*/cmake/*__rosidl_generator_pyExport.cmake"):
    text = export.read_text()
    for there, here in HERE.items():
        text = re.sub(there, here, text)
    export.write_text(text)

for generator in Path(sys.prefix, "share").glob("rosidl_*_cpp/cmake/*.cmake"):
    text = generator.read_text()
    generator.write_text(re.sub(r"ament_register_extension\([^)]*\)", "", text))
