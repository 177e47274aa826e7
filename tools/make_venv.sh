#!/usr/bin/env bash
# make_venv.sh PYTHON FOLDER: a virtual environment with the pinned packages, and system libraries
# that the Blender wheel links against, where apt can install them.
set -euo pipefail
python=$1 folder=$2
here=$(cd "$(dirname "$0")/.." && pwd)

command -v "$python" >/dev/null || {
  echo "$python is not installed; name another with make PYTHON=..." >&2; exit 2; }
version=$("$python" -c 'import sys; print("py%d%d" % sys.version_info[:2])')
pins=$here/requirements/$version.txt
[[ -f $pins ]] || { echo "$python is $version; Python 3.11 or 3.13 is needed" >&2; exit 2; }

"$python" -m venv "$folder"
"$folder/bin/pip" install --quiet --disable-pip-version-check --requirement "$pins"
"$folder/bin/pip" install --quiet --disable-pip-version-check --no-deps --no-build-isolation \
  --editable "$here" 2>/dev/null ||
  "$folder/bin/pip" install --quiet --disable-pip-version-check --no-deps --editable "$here"

if ! "$folder/bin/python" -c 'import bpy' 2>/dev/null; then
  libraries='libx11-6 libxrender1 libxxf86vm1 libxfixes3 libxi6 libxkbcommon0 libsm6 libice6 libegl1 libgl1 libgomp1'
  echo "bpy does not load; trying to install what it links against: $libraries" >&2
  if [[ $(id -u) == 0 ]] && command -v apt-get >/dev/null; then
    apt-get update -q && apt-get install -y -q --no-install-recommends $libraries
  fi
  "$folder/bin/python" -c 'import bpy' || {
    echo "bpy still does not load: install $libraries" >&2; exit 1; }
fi
