#!/bin/sh
# Print the prefix of a sourced ROS 2 distribution, Jazzy or a later one, or nothing.
# Its mark is rclcpp: the wheels from PyPI, which env.sh also puts on AMENT_PREFIX_PATH, have none.
case "${ROS_DISTRO-}" in jazzy | kilted | lyrical) ;; *) exit 0 ;; esac
IFS=:
for prefix in ${AMENT_PREFIX_PATH-}; do
    if [ -e "$prefix/share/rclcpp/package.xml" ]; then
        echo "$prefix"
        exit
    fi
done
