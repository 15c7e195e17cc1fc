# Make this shell one in which `corrector`, `omsm`, ... run by name. Source it, after `make setup`:
#     . ./env.sh                (any POSIX shell, in this folder)
#     source /path/to/env.sh    (bash, anywhere)
# Sourced again, it changes nothing. It leaves no variables or functions of its own behind.

_omsm_root=$PWD
[ -z "${BASH_SOURCE-}" ] || _omsm_root=$(cd "$(dirname "$BASH_SOURCE")" && pwd)

_omsm_problem=
if [ ! -x "$_omsm_root/.venv/bin/python" ]; then
    _omsm_problem="$_omsm_root has no .venv yet: run 'make setup', and source me in that folder"
elif [ ! -d "$_omsm_root/.venv/share/rclpy" ] && [ -z "$("$_omsm_root/bootstrap/distribution.sh")" ]; then
    _omsm_problem="set up on top of a ROS 2 distribution: source its setup.sh first"
fi
if [ -n "$_omsm_problem" ]; then
    echo "env.sh: $_omsm_problem" >&2
    unset _omsm_root _omsm_problem
    return 1
fi

# _omsm_prepend VARIABLE FOLDER: unless it is in the list already
_omsm_prepend() {
    eval "_omsm_list=\${$1-}"
    case ":$_omsm_list:" in
        *":$2:"*) ;;
        *) export "$1=$2${_omsm_list:+:$_omsm_list}" ;;
    esac
}

if [ -d "$_omsm_root/.venv/share/rclpy" ]; then
    # ROS comes from wheels in .venv. Another ROS underneath would mix two builds of the same
    # libraries, so what its setup.sh left in the environment goes.
    case "${AMENT_PREFIX_PATH-}" in
        *"$_omsm_root/.venv"*) ;; # sourced again
        *) [ -z "${ROS_DISTRO-}" ] || unset ROS_DISTRO PYTHONPATH LD_LIBRARY_PATH ;;
    esac
    export ROS_DISTRO=jazzy
    export AMENT_PREFIX_PATH="$_omsm_root/.venv" CMAKE_PREFIX_PATH="$_omsm_root/.venv"
    export RMW_IMPLEMENTATION=rmw_fastrtps_cpp # the only one there is in wheels
    # Python adds .venv's libraries to LD_LIBRARY_PATH as it starts, unless told that it has.
    unset _ROS_WHEELS_BOOTSTRAP_COMPLETE
    # A machine without a ROS distribution tries things out: keep off the network unless told.
    export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
fi
for _omsm_package in tf2_msgs omsm_msgs omsm_ros; do
    # Built where ROS comes from wheels; a distribution has its own.
    [ "$_omsm_package" != tf2_msgs ] || [ -d "$_omsm_root/install/tf2_msgs" ] || continue
    _omsm_prepend AMENT_PREFIX_PATH "$_omsm_root/install/$_omsm_package"
    for _omsm_folder in "$_omsm_root/install/$_omsm_package"/lib/python3.*/site-packages; do
        _omsm_prepend PYTHONPATH "$_omsm_folder"
    done
done
[ ! -d "$_omsm_root/install/tf2_msgs" ] ||
    _omsm_prepend LD_LIBRARY_PATH "$_omsm_root/install/tf2_msgs/lib"
_omsm_prepend LD_LIBRARY_PATH "$_omsm_root/install/omsm_msgs/lib"
_omsm_prepend PYTHONPATH "$_omsm_root" # the source before its installed copy: edits are live
_omsm_prepend PATH "$_omsm_root/.venv/bin"
_omsm_prepend PATH "$_omsm_root/install/omsm_ros/lib/omsm_ros"
export VIRTUAL_ENV="$_omsm_root/.venv"

unset _omsm_root _omsm_problem _omsm_list _omsm_package _omsm_folder
unset -f _omsm_prepend
