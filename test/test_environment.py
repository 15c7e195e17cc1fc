"""``env.sh`` sets what ``ros2 doctor`` asks for."""

import os
import subprocess
from pathlib import Path

import omsm_ros

ROOT = Path(omsm_ros.__file__).resolve().parent.parent


def test_with_ros_from_wheels_the_distribution_is_named(tmp_path):
    (tmp_path / ".venv/share/rclpy").mkdir(parents=True)
    (tmp_path / ".venv/bin").mkdir()
    (tmp_path / ".venv/bin/python").symlink_to("/bin/sh")
    (tmp_path / "env.sh").write_bytes((ROOT / "env.sh").read_bytes())
    bare = {"PATH": os.environ["PATH"], "ROS_DISTRO": "humble"}
    for environment in (bare, {"PATH": bare["PATH"]}):
        said = subprocess.run(
            ["sh", "-c", '. ./env.sh && echo "$ROS_DISTRO $RMW_IMPLEMENTATION"'],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        assert said == "jazzy rmw_fastrtps_cpp\n"


def test_the_manual_says_that_wheels_have_no_ros2_command():
    manual = (ROOT / "docs" / "nodes.md").read_text(encoding="utf-8")
    assert "ROS from wheels has no `ros2` command" in manual
