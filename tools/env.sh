# SPDX-License-Identifier: Apache-2.0
# Enter the workspace (bash, zsh): `. tools/env.sh`. Afterwards python, starpos, ros2 run and colcon are the workspace's own.

if [ -n "${ZSH_VERSION:-}" ]; then
  eval '_starpos_env=${(%):-%x}' _starpos_shell=zsh
elif [ -n "${BASH_VERSION:-}" ]; then
  _starpos_env=${BASH_SOURCE[0]} _starpos_shell=bash
else
  echo "starpos: this shell is neither bash nor zsh, which ROS's set-up files are for: start bash and enter from there" >&2
  return 1
fi
_starpos_root=$(cd "$(dirname "$_starpos_env")/.." >/dev/null && pwd)
if [ ! -f "$_starpos_root/.underlay/stamp" ] || [ ! -f "$_starpos_root/install/.built" ]; then
  echo "starpos: nothing is built in $_starpos_root yet, or not to the end: make -C $_starpos_root build" >&2
  unset _starpos_env _starpos_shell _starpos_root
  return 1
fi

# the set-up files of ROS and colcon are not written for `set -u` and `set -e`
_starpos_flags=$-
set +eu
if [ -f "$_starpos_root/.underlay/venv/local_setup.$_starpos_shell" ]; then
  . "$_starpos_root/.underlay/venv/local_setup.$_starpos_shell"
else # over a ROS that is sourced already
  case ":$PATH:" in
    *":$_starpos_root/.underlay/venv/bin:"*) ;;
    *) export PATH="$_starpos_root/.underlay/venv/bin:$PATH" ;;
  esac
fi
. "$_starpos_root/install/local_setup.$_starpos_shell"
case $_starpos_flags in *u*) set -u ;; esac
case $_starpos_flags in *e*) set -e ;; esac
# a camera's driver that is started from here may send large frames best effort
if [ -z "${FASTRTPS_DEFAULT_PROFILES_FILE:-}${FASTDDS_DEFAULT_PROFILES_FILE:-}" ]; then
  export FASTRTPS_DEFAULT_PROFILES_FILE="$_starpos_root/install/starpos_bringup/share/starpos_bringup/config/large_frames.xml"
fi
unset _starpos_env _starpos_shell _starpos_root _starpos_flags
