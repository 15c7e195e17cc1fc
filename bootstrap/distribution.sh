#!/bin/sh
# Print the prefix of a sourced ROS 2 Jazzy distribution, or nothing.
# Its mark is rclcpp: the wheels from PyPI, which env.sh also puts on AMENT_PREFIX_PATH, have none.
[ "${ROS_DISTRO-}" = jazzy ] || exit 0
IFS=:
for prefix in ${AMENT_PREFIX_PATH-}; do
    if [ -e "$prefix/share/rclcpp/package.xml" ]; then
        echo "$prefix"
        exit
    fi
done
