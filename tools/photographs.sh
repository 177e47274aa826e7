#!/usr/bin/env bash
# photographs.sh [BLENDER]: the pictures of Blender's window in docs/, of out/demo, with the extension installed in
# that Blender. Needs Xvfb, xdotool and ImageMagick. SECONDS_OPEN: how long a window has to draw (default 40).
set -euo pipefail
blender=${1:-blender}
cd "$(dirname "$0")/.."
pictures=docs/pictures
export DISPLAY=:79
Xvfb $DISPLAY -screen 0 1600x1000x24 +extension GLX >/dev/null 2>&1 &
trap 'kill %1' EXIT
sleep 1

# photograph FILE WORDS...: a window on the demo's scene, with show_panel's words
photograph() {
  local file=$1; shift
  "$blender" --window-geometry 0 0 1600 1000 out/demo/avatar.blend --python tools/show_panel.py -- "$@" \
    >/dev/null 2>&1 &
  local window=$!
  sleep "${SECONDS_OPEN:-40}"
  [[ -z ${CLICK:-} ]] || { xdotool mousemove $CLICK click 1; sleep 3; }
  import -window root "$file"
  kill -9 $window; wait $window 2>/dev/null || true
}

scratch=$(mktemp -d)
photograph "$pictures/window.png"
CLICK='1160 275' photograph "$scratch/menu.png"
convert "$scratch/menu.png" -crop 700x520+740+80 +repage "$pictures/appearances.png"
photograph "$pictures/layers.png" --appearance grey --layers
for name in crop long grey; do
  photograph "$scratch/$name.png" --bare --appearance $name
  convert "$scratch/$name.png" -crop 760x780+270+110 +repage -resize 50% "$scratch/$name.png"
done
convert "$scratch/crop.png" "$scratch/long.png" "$scratch/grey.png" +append "$pictures/viewport.png"
rm -r "$scratch"
for name in window layers; do convert "$pictures/$name.png" -resize 1200x "$pictures/$name.png"; done
